"""Consumers of growing and finished maps: evaluation, file formats, report, viewer, playback."""

"""Everything that begins with a map, growing or finished: scores, formats, report, viewer, playback."""

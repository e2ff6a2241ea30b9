"""Playback of finished maps: read a run's folder, render it along camera paths, write videos and exports."""

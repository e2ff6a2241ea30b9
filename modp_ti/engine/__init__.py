"""The run loop: read frames from a tracker, map them, write snapshots and the output folder."""

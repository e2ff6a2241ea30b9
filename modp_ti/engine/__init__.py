"""A run: frames from a tracker through the mapper to an output folder, with snapshots on the way."""

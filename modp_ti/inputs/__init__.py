"""Image sources, trackers and the geometry they share: everything that produces a `TrackedFrame`."""

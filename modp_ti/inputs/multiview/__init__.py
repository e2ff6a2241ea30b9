"""Multi-view geometry: features, poses and triangulated points, for trackers that provide no points."""

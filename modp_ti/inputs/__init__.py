"""Everything that ends in a `TrackedFrame`: images, trackers, and the geometry that they share."""

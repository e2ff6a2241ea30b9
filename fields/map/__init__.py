"""The contents of the map: Gaussians, keyframes and occupancy voxels."""

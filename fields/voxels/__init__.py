"""The occupancy voxels: where the map already holds Gaussians."""

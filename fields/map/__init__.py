"""What the map is: Gaussians, keyframes and the voxels that are occupied."""

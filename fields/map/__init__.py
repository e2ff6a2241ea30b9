"""The contents of the map: Gaussians, keyframes and the trajectory."""

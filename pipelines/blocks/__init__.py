"""Maps that do not fit into memory: blocks of Gaussians, and images of keyframes, on disk while no view needs them."""

"""How the map, its poses and its exposures are fitted to the images: losses, gradients, steps, safeguards."""

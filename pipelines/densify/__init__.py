"""Which Gaussians come and which go, and how deep in the image new ones lie."""

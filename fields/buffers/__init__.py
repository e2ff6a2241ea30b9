"""Buffers of the renderer: images and gradients, tiles, (tile, Gaussian) pairs, the view, projected Gaussians."""

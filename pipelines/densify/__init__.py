"""Densification and pruning of Gaussians, and the depth estimates for new ones."""

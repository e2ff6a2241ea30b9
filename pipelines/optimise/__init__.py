"""Optimisation of Gaussians, poses and exposures: losses, gradients, Adam steps, safeguards."""

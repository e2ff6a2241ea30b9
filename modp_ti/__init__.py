"""MODP-Ti: a photorealistic 3D Gaussian map from one RGB camera, built while the frames arrive."""

__version__ = "0.1.0"

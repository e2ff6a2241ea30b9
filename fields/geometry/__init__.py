"""Rigid motions, similarities, the camera and small vectors, for NumPy, PyTorch and Taichi."""

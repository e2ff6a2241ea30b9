"""Geometry for NumPy, PyTorch and Taichi: rigid motions, similarities, the camera model, 3-vectors."""

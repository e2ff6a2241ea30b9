"""The Taichi runtime: start, compilation, launches and readback. All use of Taichi's private API is in this package."""

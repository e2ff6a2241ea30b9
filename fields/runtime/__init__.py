"""The engine: start, compilation, launches and readback. All use of its private API is in this package."""

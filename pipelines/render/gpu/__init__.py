"""The renderer's GPU kernels: one thread per pixel, shared memory, sorts and scans on the device, no readback.

Each class replaces the class in the module of the same name in `pipelines/render/cpu`, which is also its reference.
Taichi launches on the default stream of the device's primary context, which PyTorch uses as well, so that kernels and
tensor operations are ordered without further synchronisation.
"""

"""The GPU's form of the kernels: a thread a pixel, shared memory, sorts and scans on the device, nothing read back.

Each class stands in for that of the same place in `pipelines/render/cpu`, which is the form for the CPU and the
reference. Taichi launches on the default stream of the device's primary context, which is PyTorch's: kernels and tensor
operations follow one another without further synchronisation.
"""

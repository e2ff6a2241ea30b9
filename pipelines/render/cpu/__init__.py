"""The renderer's kernels for a CPU, which are also the reference for those in `pipelines/render/gpu`."""

"""The renderer's CPU kernels, which are also the reference for those in `pipelines/render/gpu`."""

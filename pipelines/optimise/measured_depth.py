"""Depth term of the loss, for views whose tracked points have depths that a sensor measured.

With the rendered depth D / O of the pixel of a point (depth by opacity) and the measured depth z, the relative error is
r = (D / O - z) / z, and the term is

    w mean_i (sigma / 2) log(1 + (r_i / sigma)^2).

Its gradient is largest at r = sigma, the deviation of the sensor, and falls beyond it, so that wrong depths do little.
Photometric errors place smooth surfaces badly along the ray; this places them as well as the sensor does.
"""
# pyright: reportInvalidTypeForm=false

import numpy as np
import torch

from fields.buffers.images import PAD, ImageBuffers
from fields.geometry.camera import PinholeCamera
from fields.map.keyframe import Keyframe
from fields.runtime.backend import without_waiting
from fields.runtime.compiled_kernel import CompiledKernel
from fields.runtime.engine import ti

# Opacity below which the rendered depth means nothing.
LEAST_OPACITY = 0.5


@ti.data_oriented
class MeasuredDepthLoss:
    """Compares `images.depth` with the measured depths of a view.

    Args:
        images: The image buffers of the renderer.
        weight: Weight w of the term; 0 for no term.
    """

    def __init__(self, images: ImageBuffers, weight: float) -> None:
        self.images = images
        self.weight = weight
        self._pixels: np.ndarray | torch.Tensor | None = None
        self._compare, self._reset = CompiledKernel(self._write_gradients), CompiledKernel(self._clear_gradients)

    def backward(self, view: Keyframe, camera: PinholeCamera, scale: float) -> bool:
        """Fill `images.depth_grad` and `images.opacity_grad` with scale * d loss / d image.

        Args:
            view: The rendered view.
            camera: Camera of the rendered image.
            scale: Factor on the gradient.

        Returns:
            Whether the view has measured depths. If so, call `clear` after the renderer's `backward`.
        """
        if self.weight == 0 or view.depth_deviation is None:
            return False
        z = view.points.depths(view.T_tracked)
        size = np.array([camera.width, camera.height])
        x, y = np.floor(view.points.pixels * (size / [view.camera.width, view.camera.height])).astype(np.int32).T
        seen = (z > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        # One depth a pixel, so that no two of them write to one place.
        at, first = np.unique(((y + PAD) * self.images.stride + PAD + x)[seen], return_index=True)
        if len(at) == 0:
            return False
        self._pixels = without_waiting(at)
        depths = without_waiting(z[seen][first].astype(self.images.dtype))
        self._compare(len(at), self.weight * scale / len(at), view.depth_deviation, self._pixels, depths)
        return True

    def clear(self) -> None:
        """Set the gradients of the last `backward` to zero again."""
        if self._pixels is not None:
            self._reset(len(self._pixels), self._pixels)
            self._pixels = None

    @ti.kernel
    def _write_gradients(
        self, n: ti.i32, weight: ti.f32, deviation: ti.f32, pixels: ti.types.ndarray(), depths: ti.types.ndarray()
    ):
        for i in range(n):
            at, z = pixels[i], depths[i]
            opacity, depth = self.images.opacity[at], self.images.depth[at]
            if opacity > LEAST_OPACITY:
                u = (depth / opacity - z) / (z * deviation)
                gradient = weight * u / ((1.0 + u * u) * z * opacity)
                self.images.depth_grad[at] = gradient
                self.images.opacity_grad[at] = -gradient * depth / opacity

    @ti.kernel
    def _clear_gradients(self, n: ti.i32, pixels: ti.types.ndarray()):
        for i in range(n):
            self.images.depth_grad[pixels[i]] = 0.0
            self.images.opacity_grad[pixels[i]] = 0.0

"""How much every Gaussian shows in a set of views, so that those that show nothing can go."""

from collections.abc import Iterable

import taichi as ti
import torch
from numpy.typing import NDArray

from fields.map.gaussians import GaussianField
from fields.map.keyframes import Keyframe
from fields.runtime.backend import torch_device
from pipelines.render.renderer import Renderer

__all__ = ["Contribution"]


@ti.data_oriented
class Contribution:
    """The pixels that a Gaussian covers in the view that shows most of it.

    That is the largest sum, over the views, of its weight alpha T at their valid pixels. Compositing's backward pass
    gives it: the derivative of the sum of all red values by the Gaussian's own.
    """

    def __init__(self, gaussians: GaussianField, renderer: Renderer) -> None:
        self.gaussians = gaussians
        self.renderer = renderer
        self.images, self.projected = renderer.images, renderer.projected

    def measure(self, views: Iterable[Keyframe], near: float) -> NDArray:
        """Pixels (N,) of every Gaussian. near: depth [scene units] below which nothing is drawn."""
        renderer, images = self.renderer, self.images
        largest = torch.zeros(self.gaussians.count, dtype=torch.float32, device=torch_device())
        for view in views:
            renderer.forward(view.camera, view.T_camera_world, near)
            images.set_reference(view.rgba)
            self._ask_for_weights(3 * images.plane, images.plane)
            renderer.compositing.backward()
            self._keep_largest(largest)
            renderer.view_renders += 1
        return largest.cpu().numpy()

    @ti.kernel
    def _ask_for_weights(self, places: ti.i32, plane: ti.i32):
        for i in range(places):
            weight = ti.cast(0.0, self.images.real)
            if i < plane:
                weight = self.images.valid[i]
            self.images.colour_grad[i] = weight

    @ti.kernel
    def _keep_largest(self, largest: ti.types.ndarray(dtype=ti.f32, ndim=1)):
        for s in range(self.projected.seen[None]):
            i = self.projected.gaussian[s]
            largest[i] = ti.max(largest[i], ti.cast(self.projected.colour.grad[s][0], ti.f32))

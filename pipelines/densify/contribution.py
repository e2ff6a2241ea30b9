"""The contribution of each Gaussian to a set of views, for the removal of invisible Gaussians."""
# pyright: reportArgumentType=false, reportInvalidTypeForm=false, reportOptionalSubscript=false

from collections.abc import Iterable

import torch
from numpy.typing import NDArray

from fields.map.gaussians import GaussianField
from fields.map.keyframes import Keyframe
from fields.runtime.backend import torch_device
from fields.runtime.engine import ti
from pipelines.render.renderer import Renderer

__all__ = ["Contribution"]


@ti.data_oriented
class Contribution:
    """Measures how many pixels each Gaussian covers in the view that shows most of it.

    The coverage in one view is the sum of the Gaussian's compositing weight alpha T over the valid pixels. It is
    computed by compositing's backward pass, as the derivative of the sum of all red values with respect to the
    Gaussian's red value.
    """

    def __init__(self, gaussians: GaussianField, renderer: Renderer) -> None:
        self.gaussians = gaussians
        self.renderer = renderer
        self.images, self.projected = renderer.images, renderer.projected

    def measure(self, views: Iterable[Keyframe], near: float) -> NDArray:
        """Render all views and return the largest coverage of each Gaussian.

        Args:
            views: Views to render.
            near: Depth below which nothing is drawn [scene units].

        Returns:
            Coverage (N,) float32 [px].
        """
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

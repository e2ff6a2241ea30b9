"""The contribution of each Gaussian to a set of views, for the removal of invisible Gaussians."""
# pyright: reportArgumentType=false, reportInvalidTypeForm=false, reportOptionalSubscript=false

from collections.abc import Iterable

from fields.map.gaussians import GaussianField
from fields.map.keyframe import Keyframe
from fields.runtime.engine import ti
from pipelines.render.renderer import Renderer


@ti.data_oriented
class Contribution:
    """Measures how many pixels each Gaussian covers in the view that shows most of it, as `GaussianField.coverage`.

    The coverage in one view is the sum of the Gaussian's compositing weight alpha T over the valid pixels. It is
    computed by compositing's backward pass, as the derivative of the sum of all red values with respect to the
    Gaussian's red value.
    """

    def __init__(self, gaussians: GaussianField, renderer: Renderer) -> None:
        self.gaussians = gaussians
        self.renderer = renderer
        self.images, self.projected = renderer.images, renderer.projected

    def begin(self) -> None:
        """Set the coverage of all Gaussians to zero."""
        if self.gaussians.count:
            self._clear(self.gaussians.count)

    def measure(self, views: Iterable[Keyframe], near: float, level: int = 0) -> None:
        """Render further views, and raise each Gaussian's coverage to that in the view that shows most of it.

        Args:
            views: Views to render.
            near: Depth below which nothing is drawn [scene units].
            level: Pyramid level to render at. The coverage is that in pixels of the full size, nearly the same from
                each level.
        """
        renderer, images = self.renderer, self.images
        for view in views:
            image = view.image(level)
            renderer.forward(image.camera, view.T_camera_world, near)
            images.set_reference(image.rgba)
            self._ask_for_weights(3 * images.plane, images.plane)
            renderer.compositing.backward()
            self._keep_largest(view.camera.width * view.camera.height / (image.camera.width * image.camera.height))
            renderer.view_renders += 1

    @ti.kernel
    def _clear(self, count: ti.i32):
        for i in range(count):
            self.gaussians.coverage[i] = 0.0

    @ti.kernel
    def _ask_for_weights(self, places: ti.i32, plane: ti.i32):
        for i in range(places):
            weight = ti.cast(0.0, self.images.real)
            if i < plane:
                weight = self.images.valid[i]
            self.images.colour_grad[i] = weight

    @ti.kernel
    def _keep_largest(self, pixels: ti.f32):
        for s in range(self.projected.seen[None]):
            i = self.projected.gaussian[s]
            here = pixels * ti.cast(self.projected.colour.grad[s][0], ti.f32)
            self.gaussians.coverage[i] = ti.max(self.gaussians.coverage[i], here)

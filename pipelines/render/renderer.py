"""`Renderer`: a view of the map as colour, depth and opacity, and the way back to gradients."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import taichi as ti

from fields.buffers.device_pairs import DevicePairs
from fields.buffers.images import ImageBuffers
from fields.buffers.projected import ProjectedGaussians
from fields.buffers.tiles import TilePairs
from fields.buffers.view import ViewField
from fields.geometry.camera import PinholeCamera
from fields.map.gaussians import GaussianField
from fields.runtime.async_readback import AsyncReadback
from fields.runtime.backend import on_gpu, refuse_too_many_fields
from pipelines.render.cpu.binning import CHUNKS, Binning
from pipelines.render.cpu.compositing import Compositing
from pipelines.render.cpu.photometric_model import PhotometricModel
from pipelines.render.cpu.projection import Projection
from pipelines.render.gpu.binning import DeviceBinning
from pipelines.render.gpu.compositing import DeviceCompositing
from pipelines.render.gpu.photometric_model import DevicePhotometricModel
from pipelines.render.gpu.projection import DeviceProjection

__all__ = ["RenderedView", "Renderer"]


STAGES = (Projection, Binning, Compositing, PhotometricModel)
DEVICE_STAGES = (DeviceProjection, DeviceBinning, DeviceCompositing, DevicePhotometricModel)


@dataclass(frozen=True)
class RenderedView:
    """A picture on the host: colour (H, W, 3) not clipped, depth (H, W) as the weighted sum of z, opacity (H, W)."""

    colour: np.ndarray
    depth: np.ndarray
    opacity: np.ndarray

    def expected_depth(self, min_opacity: float = 0.5) -> np.ndarray:
        """Depth (H, W) divided by opacity; 0 where the map is thinner than `min_opacity`."""
        return np.where(self.opacity >= min_opacity, self.depth / np.maximum(self.opacity, 1e-6), 0.0)


class Renderer:
    """Differentiable renderer of one `GaussianField`.

    `forward` leaves the picture in `images`; after a loss has filled `images.colour_grad`, `backward` adds the
    gradients of the Gaussians to their fields and returns the camera's. Images of any size up to the given one.

    image_cache_gb: device memory for copies of the images compared with, on a GPU.
    view_renders: views rendered and differentiated so far, the measure of work that the modes are compared at.
    """

    def __init__(self, gaussians: GaussianField, max_width: int, max_height: int, image_cache_gb: float = 2.0) -> None:
        real = gaussians.real
        self.gaussians = gaussians
        # One SNode tree for all that compositing reads and writes: with two, Taichi fetches the trees' roots at every
        # pixel and LLVM cannot vectorise the inner loop (measured: six times slower).
        builder = ti.FieldsBuilder()
        self.view = ViewField(builder, real)
        self.projected = ProjectedGaussians(builder, gaussians.capacity, real)
        self.images = ImageBuffers(builder, max_width, max_height, real, image_cache_gb)
        if on_gpu():
            self.pairs = DevicePairs(builder, max_width, max_height)
        else:
            self.pairs = TilePairs(builder, self.images.max_tiles, CHUNKS, real=real)
        builder.finalize()
        refuse_too_many_fields(self.pairs.last_placed)
        projection, binning, compositing, photometric_model = DEVICE_STAGES if on_gpu() else STAGES
        self.projection = projection(gaussians, self.view, self.projected)
        self.binning = binning(self.view, self.projected, self.pairs)
        self.compositing = compositing(self.view, self.projected, self.pairs, self.images)
        self.photometric_model = photometric_model(self.images)
        self.view_renders = 0

    def forward(self, camera: PinholeCamera, T_camera_world: np.ndarray, near: float, exact: bool = True) -> None:
        """Render into `images`. near: depth [scene units] below which nothing is drawn.

        exact: on a GPU, wait until it is known how much is drawn. Steps of an optimisation do not; where a view has far
        more to draw than those before it, it loses the farthest once.
        """
        self.images.resize(camera.width, camera.height)
        self.view.set(camera, T_camera_world, near)
        self.projection.forward()
        self.binning.forward(exact)
        self.compositing.forward()
        self.develop(None, None)

    def develop(self, exposure: np.ndarray | None, vignette: np.ndarray | None) -> None:
        """Develop the rendered picture into a photograph with this exposure (3, 4) and vignette (H, W, 3).

        None stands for the identity.
        """
        self.photometric_model.forward(exposure, vignette)

    def backward(
        self, with_depth: bool = False, observe: Callable[[ProjectedGaussians, ViewField], None] | None = None
    ) -> None:
        """Add d loss / d Gaussian to the gradients of the Gaussians, for the view that was rendered last.

        observe: called while the gradients in the image stand; projection's backward uses them up.
        """
        self.photometric_model.backward()
        self.compositing.backward(with_depth)
        if observe is not None:
            observe(self.projected, self.view)
        self.projection.backward()
        self.view_renders += 1

    def camera_gradient(self) -> np.ndarray:
        """d loss / d xi (6,) of the T_camera_world that was rendered last, after `backward`."""
        return self.projection.camera_gradient()

    def async_camera_gradient(self) -> AsyncReadback:
        """The same, on its way to the host, which need not wait."""
        return self.projection.async_camera_gradient()

    def exposure_gradient(self) -> np.ndarray:
        """d loss / d exposure (3, 4) of the picture that was developed last, after `backward`."""
        return self.photometric_model.exposure_gradient()

    def async_exposure_gradient(self) -> AsyncReadback:
        """The same, on its way to the host, which need not wait."""
        return self.photometric_model.async_exposure_gradient()

    def render(
        self,
        camera: PinholeCamera,
        T_camera_world: np.ndarray,
        near: float,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> RenderedView:
        """Render and bring the picture to the host."""
        self.images.background[None] = ti.Vector(background)
        self.forward(camera, T_camera_world, near)
        self.images.background[None] = ti.Vector((0.0, 0.0, 0.0))
        return RenderedView(self.images.colour_to_numpy(), self.images.depth_to_numpy(), self.images.opacity_to_numpy())

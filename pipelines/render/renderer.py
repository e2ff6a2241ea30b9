"""`Renderer`: differentiable rendering of colour, depth and opacity."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from fields.buffers.device_pairs import DevicePairs
from fields.buffers.images import ImageBuffers
from fields.buffers.tiles import TilePairs
from fields.buffers.view import ProjectedGaussians, ViewField
from fields.geometry.camera import PinholeCamera
from fields.map.gaussians import GaussianField
from fields.runtime.backend import on_gpu, refuse_too_many_fields
from fields.runtime.engine import ti
from fields.runtime.tenancy import in_engine, settled
from pipelines.render.cpu.binning import CHUNKS, Binning
from pipelines.render.cpu.compositing import Compositing
from pipelines.render.cpu.losses import PhotometricLoss
from pipelines.render.cpu.photometric import Photometric
from pipelines.render.cpu.projection import Projection
from pipelines.render.formulas import LossValues
from pipelines.render.gpu.binning import DeviceBinning
from pipelines.render.gpu.compositing import DeviceCompositing
from pipelines.render.gpu.losses import DevicePhotometricLoss
from pipelines.render.gpu.photometric import DevicePhotometric
from pipelines.render.gpu.projection import DeviceProjection


class ProjectionStage(Protocol):
    """Culls, sorts and projects the Gaussians into `projected`, for the view in `view`."""

    def forward(self) -> int:
        """Fill `projected`, and return the number of visible Gaussians; on a GPU, an upper bound of it."""
        ...

    def backward(self) -> None:
        """Propagate the gradients in `projected` to the Gaussians and to the camera tangents."""

    def camera_gradient(self) -> np.ndarray:
        """Return d loss / d xi (6,) of the view's T_camera_world, summed in a fixed order."""
        ...


class BinningStage(Protocol):
    """Fills the tile pairs from `projected`."""

    def forward(self, exact: bool = True) -> None:
        """Bin the projected Gaussians.

        Args:
            exact: On a GPU, wait for the number of pairs, and make room for all of them. Otherwise the room follows
                from earlier views, and pairs beyond it are dropped.

        Raises:
            ValueError: If there are more pairs than there is room for; on a GPU, if `exact`.
        """


class CompositingStage(Protocol):
    """Composites `projected` into `images`, and propagates gradients back."""

    def forward(self) -> None:
        """Fill `images.colour`, `.depth` and `.opacity`."""

    def backward(self, with_depth: bool = False) -> None:
        """Propagate `images.*_grad`, with or without `images.depth_grad`, to the gradients in `projected`."""


class PhotometricStage(Protocol):
    """Applies exposure and vignette to `images.colour` in place, and propagates `images.colour_grad` back."""

    def forward(self, exposure: np.ndarray | torch.Tensor | None, vignette: np.ndarray | None) -> None:
        """Apply exposure and vignette to the last rendered image.

        Args:
            exposure: Exposure (A, b) (3, 4), on a GPU possibly a tensor (12,) on the device; None for the identity.
            vignette: Vignette (H, W, 3) at the camera's full size, which is resized to the image; None for none.
        """

    def backward(self) -> None:
        """Propagate `images.colour_grad` back to the render, and restore the render in `images.colour`."""

    def exposure_gradient(self) -> np.ndarray:
        """Return d loss / d (A, b) (3, 4) of the last image, after `backward`."""
        ...


class LossStage(Protocol):
    """Compares `images.colour` with a reference image at its valid pixels.

    Attributes:
        lag: Number of steps after which the values should be read, so that the host does not wait: 0 on the CPU, where
            they are available at once.
    """

    lag: int

    def forward(self, rgba: NDArray[np.uint8]) -> LossValues:
        """Evaluate the loss against an image as in `ImageBuffers.set_reference`. Writes the SSIM map to `images.ssim`.

        Masked pixels of the render are replaced by the reference, so that they do not affect any window. On a GPU, the
        values wait for the device when they are read.
        """
        ...

    def send(self) -> None:
        """Start the asynchronous copy of the values so far to the host."""

    def backward(self, ssim_weight: float, scale: float = 1.0) -> None:
        """Fill `images.colour_grad` with scale * d loss / d colour, loss = (1 - w) L1 + w (1 - SSIM).

        Args:
            ssim_weight: Weight w of 1 - SSIM.
            scale: Factor on the gradient.
        """


Stages = tuple[ProjectionStage, BinningStage, CompositingStage, PhotometricStage, LossStage]


def make_stages(
    gaussians: GaussianField,
    view: ViewField,
    projected: ProjectedGaussians,
    pairs: TilePairs | DevicePairs,
    images: ImageBuffers,
) -> Stages:
    """Make the stages of a renderer in the form of the running device, which is that of `pairs`."""
    if isinstance(pairs, DevicePairs):
        binning = DeviceBinning(view, projected, pairs)
        return (
            DeviceProjection(gaussians, view, projected, binning),
            binning,
            DeviceCompositing(gaussians, binning, images),
            DevicePhotometric(images),
            DevicePhotometricLoss(images),
        )
    return (
        Projection(gaussians, view, projected),
        Binning(view, projected, pairs),
        Compositing(view, projected, pairs, images),
        Photometric(images),
        PhotometricLoss(images),
    )


@dataclass(frozen=True)
class RenderedView:
    """A rendered view on the host.

    Attributes:
        colour: Colour (H, W, 3), not clipped.
        depth: Depth (H, W) as the weighted sum of z, not divided by opacity.
        opacity: Opacity (H, W).
    """

    colour: np.ndarray
    depth: np.ndarray
    opacity: np.ndarray

    def expected_depth(self, min_opacity: float = 0.5) -> np.ndarray:
        """Return the depth (H, W) divided by opacity; 0 where the opacity is below `min_opacity`."""
        return np.where(self.opacity >= min_opacity, self.depth / np.maximum(self.opacity, 1e-6), 0.0)


@in_engine("forward", "develop", "backward", "camera_gradient", "exposure_gradient", "render", "rendered")
class Renderer:
    """Differentiable renderer of one `GaussianField`, for images of any size up to a maximum.

    `forward` renders into `images`. After a loss has filled `images.colour_grad`, `backward` adds the gradients of the
    Gaussians to their fields; `camera_gradient` then returns the gradient of the pose.

    Args:
        gaussians: The Gaussians.
        max_width: Largest image width [px].
        max_height: Largest image height [px].
        image_cache_gb: Device memory for copies of reference images, on a GPU [GiB].

    Attributes:
        images: Image buffers.
        loss: Compares the rendered image with the reference image.
        view_renders: Number of views rendered and differentiated so far, the measure of work in comparisons of the
            online and offline modes.

    Example:
        view = modp_ti.Renderer(gaussians, 640, 480).render(camera, T_camera_world, near=0.01)
        print(view.colour.shape, view.expected_depth().max())
    """

    def __init__(self, gaussians: GaussianField, max_width: int, max_height: int, image_cache_gb: float = 2.0) -> None:
        real = gaussians.real
        self.gaussians = gaussians
        largest = PinholeCamera(1.0, 1.0, 0.0, 0.0, max_width, max_height)  # refuses a size that is not whole
        max_width, max_height = largest.width, largest.height
        with settled(nodes=3) as self.tenancy:
            # One SNode tree for everything that compositing reads and writes. With two, Taichi fetches the trees' roots
            # at every pixel, and LLVM cannot vectorise the inner loop (measured: six times slower).
            builder = ti.FieldsBuilder()
            self.view = ViewField(builder, real)
            self.projected = ProjectedGaussians(builder, gaussians.capacity, real)
            self.images = ImageBuffers(builder, max_width, max_height, real, image_cache_gb)
            if on_gpu():
                self.pairs = DevicePairs(builder, max_width, max_height)
            else:
                self.pairs = TilePairs(builder, self.images.max_tiles, CHUNKS, real=real)
            stages = make_stages(gaussians, self.view, self.projected, self.pairs, self.images)
            self.projection, self.binning, self.compositing, self.photometric, self.loss = stages
            builder.finalize()
            refuse_too_many_fields(self.pairs.last_placed)
        self.view_renders = 0

    def forward(
        self, camera: PinholeCamera, T_camera_world: np.ndarray | torch.Tensor, near: float, exact: bool = True
    ) -> None:
        """Render a view into `images`.

        Args:
            camera: Intrinsics and image size.
            T_camera_world: Pose (4, 4), or as in `ViewField.set`.
            near: Depth below which nothing is drawn [scene units].
            exact: On a GPU, wait for the number of tile pairs. Optimisation steps do not wait; if a view has far more
                pairs than the views before it, its farthest pairs are dropped once.
        """
        self.images.resize(camera.width, camera.height)
        self.view.set(camera, T_camera_world, near)
        self.projection.forward()
        self.binning.forward(exact)
        self.compositing.forward()
        self.develop(None, None)

    def develop(self, exposure: np.ndarray | torch.Tensor | None, vignette: np.ndarray | None) -> None:
        """Apply an exposure (A, b) (3, 4) and a vignette (H, W, 3) to the rendered image, each possibly None."""
        self.photometric.forward(exposure, vignette)

    def backward(
        self, with_depth: bool = False, observe: Callable[[ProjectedGaussians, ViewField], None] | None = None
    ) -> None:
        """Add d loss / d Gaussian to the gradients of the Gaussians, for the last rendered view.

        Args:
            with_depth: Also propagate `images.depth_grad`.
            observe: Called with the gradients of the projected Gaussians, before projection's backward pass overwrites
                them.
        """
        self.photometric.backward()
        self.compositing.backward(with_depth)
        if observe is not None:
            observe(self.projected, self.view)
        self.projection.backward()
        self.view_renders += 1

    def camera_gradient(self) -> np.ndarray:
        """Return d loss / d xi (6,) of the last rendered T_camera_world. Call it after `backward`."""
        return self.projection.camera_gradient()

    def exposure_gradient(self) -> np.ndarray:
        """Return d loss / d exposure (3, 4) of the last rendered image. Call it after `backward`."""
        return self.photometric.exposure_gradient()

    def render(
        self,
        camera: PinholeCamera,
        T_camera_world: np.ndarray,
        near: float,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> RenderedView:
        """Render a view and copy it to the host.

        Args:
            camera: Intrinsics and image size.
            T_camera_world: Pose (4, 4).
            near: Depth below which nothing is drawn [scene units].
            background: Colour where no Gaussian is drawn.

        Returns:
            Colour, depth and opacity.
        """
        self.images.background[None] = ti.Vector(background)
        self.forward(camera, T_camera_world, near)
        self.images.background[None] = ti.Vector((0.0, 0.0, 0.0))
        return self.rendered()

    def rendered(self) -> RenderedView:
        """Return a copy of the last rendered view, with its exposure and vignette if it was developed with them."""
        return RenderedView(self.images.colour_to_numpy(), self.images.depth_to_numpy(), self.images.opacity_to_numpy())

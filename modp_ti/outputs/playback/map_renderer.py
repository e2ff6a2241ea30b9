"""`MapRenderer`: loads a saved map into the renderer."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.map.gaussians import GaussianField
from fields.runtime.backend import on_gpu
from fields.runtime.engine import engine
from fields.runtime.tenancy import ensure_started, in_engine, settled
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.panorama import Face
from pipelines.render.renderer import RenderedView, Renderer
from pipelines.whole.hierarchy import ShownMap

# Largest side of a picture [px]. The buffers of larger ones approach the gigabyte beyond which Taichi is not safe.
MAX_SIDE = 2048
# Minimum capacity on backends with sparse storage. It equals that of a run, so that the run's cached kernels are
# reused.
POOL = 1_500_000


def start_device(device: str) -> str:
    """Start Taichi, unless maps are in use in this process: then they share it.

    Args:
        device: "cpu", "cuda", "vulkan", "metal" or "auto".

    Returns:
        The backend in use.

    Raises:
        InputError: If Taichi does not start, or is in use on another device.
    """
    try:
        return ensure_started(device)
    except RuntimeError as error:
        raise InputError(str(error)) from None


@in_engine("view")
class MapRenderer:
    """Renders a saved map. Taichi must have been started.

    Of a map that is larger than what the engine can hold, only what a picture shows is loaded before it is rendered.

    Args:
        gaussians: Arrays by name, as from `GaussianField.to_numpy`.
        width: Largest picture width [px].
        height: Largest picture height [px].
        near: Depth below which nothing is drawn [scene units].

    Raises:
        InputError: If the size exceeds `MAX_SIDE`, or the Gaussians are invalid.
    """

    def __init__(self, gaussians: Mapping[str, NDArray], width: int, height: int, near: float) -> None:
        if max(width, height) > MAX_SIDE:
            raise InputError(
                f"{width}x{height}: pictures have at most {MAX_SIDE} pixels on a side; ask for smaller ones"
            )
        count, coefficients = gaussians["sh"].shape[:2]
        pool = min(max(count, 1) if on_gpu() else max(count, POOL), engine().max_gaussians)
        with settled(nodes=4) as self.tenancy:
            field = GaussianField(round(coefficients**0.5) - 1, pool)
            self._shown = ShownMap(field, gaussians)
            try:
                if self._shown.fits:
                    field.load(dict(gaussians))
            except ValueError as error:
                raise InputError(f"the map cannot be rendered: {error}") from None
            self.renderer = Renderer(field, width, height)
        self.near = near

    @property
    def is_whole(self) -> bool:
        """Whether the whole map is loaded."""
        return self._shown.fits

    def view(self, camera: PinholeCamera, T_camera_world: NDArray[np.float64]) -> RenderedView:
        """Render the map from T_camera_world (4, 4) on a black background."""
        if not self._shown.fits:
            self._shown.show(camera, T_camera_world)
        return self.renderer.render(camera, T_camera_world, self.near)

    def rays(self, camera: PinholeCamera) -> NDArray[np.float64]:
        """Return the rays (H, W, 3) of a view's pixels: a point is its depth times its ray."""
        return Face(camera, np.eye(4)).rays()

    def picture(self, camera: PinholeCamera, T_camera_world: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Render the map's colours (H, W, 3) as 8-bit values."""
        return eight_bits(self.view(camera, T_camera_world).colour)


def eight_bits(colour: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Convert colours to 8 bits, after clipping to [0, 1]."""
    return np.round(np.clip(colour, 0.0, 1.0) * 255.0).astype(np.uint8)

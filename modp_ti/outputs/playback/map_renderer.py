"""`MapRenderer`: a saved map in the renderer."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.map.gaussians import GaussianField
from fields.runtime.backend import initialise, on_gpu
from modp_ti.files.errors import InputError
from pipelines.render.renderer import RenderedView, Renderer

__all__ = ["MAX_SIDE", "MapRenderer", "start_device"]

# Pixels on a side: the buffers of a larger picture come near the gigabyte beyond which Taichi is not safe.
MAX_SIDE = 2048
# Where storage is sparse, every map gets the pool of a run, so that it finds that run's kernels in the cache.
POOL = 1_500_000


def start_device(device: str) -> str:
    """Start Taichi on "cpu", "cuda" or "auto"; the backend taken. Raises InputError where it does not start."""
    try:
        return initialise(device)
    except RuntimeError as error:
        raise InputError(str(error)) from None


class MapRenderer:
    """Renders Gaussians, by name as `GaussianField.to_numpy`, in pictures of up to width x height. Taichi runs already.

    near: depth [scene units] below which nothing is drawn. Raises InputError for a size beyond `MAX_SIDE`.
    """

    def __init__(self, gaussians: Mapping[str, NDArray], width: int, height: int, near: float) -> None:
        if max(width, height) > MAX_SIDE:
            raise InputError(
                f"{width}x{height}: pictures have at most {MAX_SIDE} pixels on a side; ask for smaller ones"
            )
        count, coefficients = gaussians["sh"].shape[:2]
        field = GaussianField(round(coefficients**0.5) - 1, max(count, 1) if on_gpu() else max(count, POOL))
        try:
            field.load(dict(gaussians))
        except ValueError as error:
            raise InputError(f"the map cannot be rendered: {error}") from None
        self.renderer = Renderer(field, width, height)
        self.near = near

    def view(self, camera: PinholeCamera, T_camera_world: NDArray[np.float64]) -> RenderedView:
        """The map through `camera` from T_camera_world (4, 4), before black."""
        return self.renderer.render(camera, T_camera_world, self.near)

    def picture(self, camera: PinholeCamera, T_camera_world: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Its colours (H, W, 3) as 8 bits."""
        return eight_bits(self.view(camera, T_camera_world).colour)


def eight_bits(colour: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Colours in [0, 1], clipped to it first, as 8 bits."""
    return np.round(np.clip(colour, 0.0, 1.0) * 255.0).astype(np.uint8)

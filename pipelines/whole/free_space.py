"""Free space: Gaussians of one map that float before the surfaces that another map shows.

Only its own keyframes hold the map of a part. Beside what they see, large Gaussians with a wrong depth remain. In the
keyframes of another part, they hang before the surface like fog.
"""
# pyright: reportArgumentType=false, reportCallIssue=false, reportInvalidTypeForm=false, reportOptionalSubscript=false

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.runtime.engine import ti
from pipelines.render.renderer import Renderer

# A Gaussian is before a surface if its depth is less than this share of the surface's.
BEFORE = 0.85
# Least opacity of a pixel with a surface.
LEAST_OPACITY = 0.5


@dataclass(frozen=True)
class ShownSurface:
    """The surface that a map shows in one of its own keyframes.

    Attributes:
        number: Number of the map.
        camera: The keyframe's camera.
        T_camera_world: (4, 4) pose.
        depth: (H, W) z of the surface, 0 where there is none.
    """

    number: int
    camera: PinholeCamera
    T_camera_world: NDArray[np.float64]
    depth: NDArray[np.floating]


@ti.data_oriented
class FreeSpace:
    """Finds the Gaussians that show more before the surfaces of other maps than anywhere else.

    How much a Gaussian shows in a view is the sum of its compositing weights alpha T over the pixels with a surface.
    The sum of alpha T / D, where D is the depth of the surface, then tells the mean inverse depth of the surface where
    the Gaussian is. Both are derivatives of weighted sums of the picture's colours by the Gaussian's colour, and come
    from one backward pass of compositing.

    Args:
        renderer: Renderer of the Gaussians.
        near: Depth below which nothing is drawn [scene units].
    """

    def __init__(self, renderer: Renderer, near: float) -> None:
        self.renderer = renderer
        self.projected = renderer.projected
        self._near = near

    def surface(self, number: int, camera: PinholeCamera, T_camera_world: NDArray[np.float64]) -> ShownSurface:
        """Return what the map with this number shows in a keyframe, which must be the last rendered view."""
        depth = self.renderer.rendered().expected_depth(LEAST_OPACITY)
        return ShownSurface(number, camera, T_camera_world, depth.astype(np.float32))

    def floating(self, numbers: NDArray[np.integer], views: Sequence[ShownSurface]) -> NDArray[np.bool_]:
        """Return which of the loaded Gaussians (N,) float before the surfaces of other maps.

        Args:
            numbers: Number (N,) of the map that each Gaussian is from.
            views: The surfaces of all maps.
        """
        before, elsewhere = np.zeros(len(numbers)), np.zeros(len(numbers))
        for view in views:
            index, weight, weighted_ratio = self._shown(view)
            is_before = (weighted_ratio < BEFORE * weight) & (numbers[index] != view.number)
            before[index] += np.where(is_before, weight, 0.0)
            elsewhere[index] += np.where(is_before, 0.0, weight)
        return before > elsewhere

    def _shown(self, view: ShownSurface) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
        """Return the indices (M,) of the Gaussians in a view, and the sums (M,) of alpha T and of alpha T z / D."""
        renderer, has_surface = self.renderer, view.depth > 0
        renderer.forward(view.camera, view.T_camera_world, self._near)
        inverse = np.where(has_surface, 1.0 / np.where(has_surface, view.depth, 1.0), 0.0)
        none = np.zeros_like(inverse)
        renderer.images.set_gradients(np.stack([has_surface, inverse, none], axis=-1), none, none)
        renderer.compositing.backward()
        renderer.view_renders += 1
        count = self.projected.seen[None]
        index = np.empty(count, dtype=np.int32)
        weight, weighted_ratio = np.empty(count, dtype=np.float32), np.empty(count, dtype=np.float32)
        if count:
            self._read(index, weight, weighted_ratio)
        return index, weight, weighted_ratio

    @ti.kernel
    def _read(
        self,
        index: ti.types.ndarray(dtype=ti.i32, ndim=1),
        weight: ti.types.ndarray(dtype=ti.f32, ndim=1),
        weighted_ratio: ti.types.ndarray(dtype=ti.f32, ndim=1),
    ):
        for s in range(index.shape[0]):
            index[s] = self.projected.gaussian[s]
            weight[s] = ti.cast(self.projected.colour.grad[s][0], ti.f32)
            weighted_ratio[s] = ti.cast(self.projected.depth[s] * self.projected.colour.grad[s][1], ti.f32)

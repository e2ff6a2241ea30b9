"""Panoramas of a finished map: equirectangular pictures, resampled from the six faces of a cube around one place."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.source_settings import PanoramaSettings
from modp_ti.inputs.sources.panorama import Projection, faces_of
from modp_ti.outputs.playback.map_renderer import MapRenderer
from pipelines.render.renderer import RenderedView

# Pixels that a face shows beyond the cube's edges, for the cubic filter.
MARGIN = 3
# Columns of the tables that look up a face: cv2.remap takes no image with more than 32,767 of them.
COLUMNS = 2048


class PanoramaRenderer:
    """Renders panoramas of a saved map. Taichi must have been started.

    Args:
        gaussians: Arrays by name, as from `GaussianField.to_numpy`.
        width: Width of the panoramas, twice their height [px].
        near: Depth below which nothing is drawn [scene units].
    """

    def __init__(self, gaussians: Mapping[str, NDArray], width: int, near: float) -> None:
        self.projection = Projection(width, width // 2)
        reach = 2.0 * np.degrees(np.arctan(1.0 + MARGIN / self.projection.focal))
        settings = PanoramaSettings(projection="equirectangular", faces=4, up_down=True, fov=reach)
        self._faces = faces_of(settings, self.projection)
        side = self._faces[0].camera.width
        self._renderer = MapRenderer(gaussians, side, side, near)

    def view(self, camera: PinholeCamera, T_camera_world: NDArray[np.float64]) -> RenderedView:
        """Render the map around T_camera_world (4, 4). The panorama's middle looks along the camera's z axis.

        Depth is the distance from the camera's centre. The camera is that of no panorama, and not used.
        """
        height, width = self.projection.height, self.projection.width
        colour, other = np.empty((height * width, 3), np.float32), np.empty((height * width, 2), np.float32)
        for face, (at, x, y, length) in zip(self._faces, self._lookups, strict=True):
            view = self._renderer.view(face.camera, face.T_face_rig @ T_camera_world)
            for whole, image in ((colour, view.colour), (other, np.dstack([length * view.depth, view.opacity]))):
                whole[at] = cv2.remap(image.astype(np.float32), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return RenderedView(
            colour.reshape(height, width, 3), *np.clip(other, 0.0, [np.inf, 1.0]).T.reshape(2, height, width)
        )

    def rays(self, camera: PinholeCamera) -> NDArray[np.float64]:
        """Return the unit rays (H, W, 3) of a panorama's pixels, as `MapRenderer.rays` does."""
        return self.projection.rays()

    @cached_property
    def _lookups(self) -> list[tuple[NDArray, ...]]:
        """For each face: the panorama's pixels that it shows, their places x, y in it, and its distances at depth 1."""
        rays = self.projection.rays().reshape(-1, 3).astype(np.float32)
        nearest = np.argmax([rays @ face.T_face_rig[2, :3].astype(np.float32) for face in self._faces], axis=0)
        lookups = []
        for number, face in enumerate(self._faces):
            at = np.flatnonzero(nearest == number)
            at = np.resize(at, (-(-len(at) // COLUMNS), COLUMNS))  # the last row is filled up with pixels of the first
            pixels = face.camera.project((rays[at] @ face.T_face_rig[:3, :3].T).reshape(-1, 3)) - 0.5
            x, y = np.ascontiguousarray(pixels.T.reshape(2, *at.shape), dtype=np.float32)
            lookups.append((at, x, y, np.linalg.norm(face.rays(), axis=2)))
        return lookups

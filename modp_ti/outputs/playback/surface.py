"""`surface_views`: depth views of a finished map's surface from its frames, for a mesh."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.mesh import LEAST_OPACITY, SurfaceView, without_edges
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.map_renderer import MapRenderer, eight_bits
from modp_ti.outputs.playback.mapped_images import grey_images
from modp_ti.outputs.progress import ProgressLine
from pipelines.surface.joined_depth import joined_depth
from pipelines.surface.matched_depth import DepthMatcher, DepthView

__all__ = ["largest_view", "painted_from", "surface_views"]

# Maximum number of views that are fused, evenly spaced over the frames.
SURFACE_VIEWS = 300
# Longer side of the depth views [px]. A pixel is then finer than the mesh's voxels.
LONGEST_SIDE = 480
# The same of the pictures that a texture is painted from.
PAINTED_VIEWS, LONGEST_PAINTED_SIDE = 100, 1024

Placed = tuple[PinholeCamera, NDArray[np.float64]]


def surface_views(run: FinishedRun, renderer: MapRenderer, line: ProgressLine) -> list[SurfaceView]:
    """Return the surface's depth and colour from the mapped frames.

    The map's depth is corrected by matching the frames' images. If these are no longer available, renders of the map
    are matched instead, which are less sharp.

    Args:
        run: The finished run.
        renderer: Renderer of its map.
        line: Shows the progress.
    """
    chosen = run.spread(SURFACE_VIEWS)
    images: list[NDArray[np.uint8]] | None = None
    try:
        images = grey_images(run, chosen, line)
    except InputError as error:
        line.note(f"note: matching the map's own pictures, for want of the images: {error}")
    pictures, views = [], []
    placed = [(_within(run.cameras[index], LONGEST_SIDE), run.poses[index]) for index in chosen]
    for number, (camera, T) in enumerate(line.through("rendering", placed, len(placed))):
        view = renderer.view(camera, T)
        pictures.append(eight_bits(view.colour))
        if images is None:
            grey = cv2.cvtColor(pictures[-1], cv2.COLOR_RGB2GRAY)
        else:
            grey = cv2.resize(images[number], (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        depth = view.expected_depth(LEAST_OPACITY).astype(np.float32)
        views.append(DepthView(camera, T, np.asarray(grey / np.float32(255.0), dtype=np.float32), depth))
    matcher = DepthMatcher(views)
    matched = [matcher.matched(index) for index in line.through("matching images", range(len(views)), len(views))]
    joined = joined_depth(
        views, matched, matcher.neighbours, line.through("joining depth", range(len(views)), len(views))
    )
    return [
        SurfaceView(view.camera, view.T_camera_world, without_edges(depth), picture / np.float32(255.0))
        for view, depth, picture in zip(views, joined, pictures, strict=True)
    ]


def painted_from(run: FinishedRun) -> list[Placed]:
    """Return camera and T_camera_world (4, 4) of the pictures to paint a texture from."""
    chosen = run.spread(PAINTED_VIEWS)
    return [(_within(run.cameras[index], LONGEST_PAINTED_SIDE), run.poses[index]) for index in chosen]


def largest_view(run: FinishedRun, texture: bool) -> tuple[int, int]:
    """Return width and height of the largest views that are rendered for a mesh [px]."""
    longest = LONGEST_PAINTED_SIDE if texture else LONGEST_SIDE
    cameras = [_within(run.cameras[index], longest) for index in run.mapped]
    return max(camera.width for camera in cameras), max(camera.height for camera in cameras)


def _within(camera: PinholeCamera, longest: int) -> PinholeCamera:
    """Return the camera for the same view with at most `longest` pixels on a side."""
    s = min(1.0, longest / max(camera.width, camera.height))
    return camera.resized(max(round(s * camera.width), 1), max(round(s * camera.height), 1))

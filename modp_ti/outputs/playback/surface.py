"""`surface_views`: depth views of a finished map's surface from its frames, for a mesh."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.matched_depth import DepthView, agreed_depth, choose_neighbours, matched_depth
from modp_ti.outputs.formats.mesh import LEAST_OPACITY, SurfaceView, without_edges
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.map_renderer import MapRenderer, eight_bits, start_device
from modp_ti.outputs.playback.mapped_images import grey_images
from modp_ti.outputs.progress import ProgressLine

__all__ = ["surface_views"]

# Maximum number of views that are fused, evenly spaced over the frames.
SURFACE_VIEWS = 300
# Longer side of the depth views [px]. A pixel is then finer than the mesh's voxels.
LONGEST_SIDE = 480


def surface_views(run: FinishedRun, device: str, line: ProgressLine) -> Iterator[SurfaceView]:
    """Yield the map's depth and colour from the mapped frames, with the depth corrected by matching their images.

    If the images are no longer available, renders of the map are matched instead, which are less sharp.

    Args:
        run: The finished run.
        device: "cpu", "cuda", "vulkan", "metal" or "auto".
        line: Shows the progress.
    """
    chosen = run.spread(SURFACE_VIEWS)
    cameras = [_within(run.cameras[index], LONGEST_SIDE) for index in chosen]
    images: list[NDArray[np.uint8]] | None = None
    try:
        images = grey_images(run, chosen, line)
    except InputError as error:
        line.note(f"note: matching the map's own pictures, for want of the images: {error}")
    with line.working("loading the map"):
        gaussians = run.gaussians
        start_device(device)
    renderer = MapRenderer(gaussians, max(c.width for c in cameras), max(c.height for c in cameras), run.record.near)
    pictures, views = [], []
    shots = list(zip(cameras, run.poses[chosen], strict=True))
    for number, (camera, T) in enumerate(line.through("rendering", shots, len(shots))):
        view = renderer.view(camera, T)
        pictures.append(eight_bits(view.colour))
        if images is None:
            grey = cv2.cvtColor(pictures[-1], cv2.COLOR_RGB2GRAY)
        else:
            grey = cv2.resize(images[number], (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        depth = view.expected_depth(LEAST_OPACITY).astype(np.float32)
        views.append(DepthView(camera, T, np.asarray(grey / np.float32(255.0), dtype=np.float32), depth))
    neighbours = [choose_neighbours(views, index) for index in range(len(views))]
    matched = [
        replace(view, depth=matched_depth(views, index, neighbours[index]))
        for index, view in enumerate(line.through("matching images", views, len(views)))
    ]
    for index, view in enumerate(line.through("fusing depth", matched, len(matched))):
        depth = without_edges(agreed_depth(matched, index, neighbours[index]))
        yield SurfaceView(view.camera, view.T_camera_world, depth, pictures[index] / np.float32(255.0))


def _within(camera: PinholeCamera, longest: int) -> PinholeCamera:
    """Return the camera for the same view with at most `longest` pixels on a side."""
    s = min(1.0, longest / max(camera.width, camera.height))
    return camera.resized(max(round(s * camera.width), 1), max(round(s * camera.height), 1))

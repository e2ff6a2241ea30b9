"""The exports of surfaces: meshes, what is free and what is solid, and the walls of the page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import camera_centres
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.collision import boundary, write_octomap, write_ros_map, write_voxels
from modp_ti.outputs.formats.dataset import new_folder
from modp_ti.outputs.formats.mesh import (
    LEAST_OPACITY,
    TRUNCATION,
    SurfaceView,
    extracted,
    fused,
    supported,
    without_edges,
    write_mesh,
)
from modp_ti.outputs.formats.textured_mesh import painted, unwrapped, write_textured_mesh
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.map_renderer import MapRenderer, eight_bits, start_device
from modp_ti.outputs.playback.run_frames import pictures
from modp_ti.outputs.progress import ProgressLine
from modp_ti.outputs.splat_page.page import levelled
from pipelines.surface.depth import DepthMatcher, DepthView, joined_depth
from pipelines.surface.free_space import VoxelSpace, carved, reached, walkable
from pipelines.surface.fusion import Placed

if TYPE_CHECKING:
    from open3d.pybind.geometry import TriangleMesh

# Edge of the mesh's voxels, and largest depth that is fused, both relative to the scene's depth.
VOXEL, FARTHEST = 1 / 160, 4.0
# Edge of the voxels of free space, and the longest straight way between two frames that a camera is taken to have gone,
# both relative to the scene's depth.
SPACE_VOXEL, JUMP = 1 / 50, 0.5
# Most views that are fused, evenly spaced over the frames, and their longer side [px]. A pixel is then finer than the
# mesh's voxels. The same of the pictures that a texture is painted from.
SURFACE_VIEWS, LONGEST_SIDE = 300, 480
PAINTED_VIEWS, LONGEST_PAINTED_SIDE = 100, 1024
# The same of the views in which the page's walls are looked for, and most triangles of these.
WALKED_VIEWS, WALKED_SIDE, WALKED_TRIANGLES = 100, 240, 10_000


def export_mesh(
    run: FinishedRun, target: Path, voxel: float | None, texture: bool, device: str, line: ProgressLine
) -> None:
    """Write the surface, with a texture or with a colour per vertex.

    Args:
        run: The finished run.
        target: The file.
        voxel: Edge of the voxels [scene units], None for the default.
        texture: Whether it gets a texture.
        device: Device for rendering.
        line: Shows the progress.
    """
    voxel = voxel or VOXEL * run.record.scene_depth
    longest = LONGEST_PAINTED_SIDE if texture else LONGEST_SIDE
    renderer = _loaded(run, longest, device, line)
    views = _surface_views(run, renderer, line)
    with line.working("fusing depth"):
        grid = fused(views, voxel, FARTHEST * run.record.scene_depth)
    with line.working("extracting the surface"):
        mesh = supported(extracted(grid), views, TRUNCATION * voxel)
    if texture:
        with line.working("unwrapping the surface"):
            flat = unwrapped(mesh)
        places = [(run.cameras[index].within(longest), run.poses[index]) for index in run.spread(PAINTED_VIEWS)]
        shots = ((*place, renderer.view(*place).colour) for place in line.through("painting", places, len(places)))
        write_textured_mesh(target, painted(flat, shots))
        return
    if target.suffix.lower() == ".ply" and run.record.origin.any():  # its coordinates are double
        mesh.translate(run.record.origin)
    write_mesh(target, mesh)


def export_collision(
    run: FinishedRun, target: Path, voxel: float | None, height: float | None, device: str, line: ProgressLine
) -> None:
    """Write what is free and what is solid to a new folder, in axes whose z points up.

    Args:
        run: The finished run.
        target: The folder.
        voxel: Edge of the voxels [scene units], None for the default.
        height: Height above the floor of the ROS map's slice [scene units], None for that of the cameras.
        device: Device for rendering.
        line: Shows the progress.

    Raises:
        InputError: If there would be too many voxels, or a height is given and no floor was seen.
    """
    with new_folder(target) as folder:
        views = _surface_views(run, _loaded(run, LONGEST_SIDE, device, line), line)
        seen = [(view.camera, view.T_camera_world, view.depth) for view in views]
        with line.working("carving space"):
            try:
                space = _carved(run, seen, voxel)
            except ValueError as error:
                raise InputError(f"{error}; use larger ones (--voxel)") from None
        places = camera_centres(run.poses)
        held = float(np.median(places @ space.R_grid_world[2]))
        floor = space.floor(held)
        if height is not None and floor is None:
            raise InputError("--height: no floor was seen below the cameras; leave it out for the cameras' height")
        slice_at = held if height is None or floor is None else floor + height
        with line.working("extracting the surface"):
            write_voxels(folder / "voxels.npz", space, run.record.origin, floor)
            write_ros_map(folder, space, slice_at)
            write_octomap(folder / "voxels.bt", space)
            write_mesh(folder / "mesh.glb", boundary(space, reached(space, places)))


def _carved(run: FinishedRun, seen: Sequence[Placed], voxel: float | None) -> VoxelSpace:
    """Carve space with depth maps of a run. Raises ValueError if there would be too many voxels."""
    depth, R = run.record.scene_depth, levelled(run).R
    way = camera_centres(run.poses)[run.way]
    jumps = np.flatnonzero(np.linalg.norm(np.diff(way, axis=0), axis=1) > JUMP * depth) + 1
    R_grid_world = np.stack([R[0], R[2], -R[1]])
    return carved(seen, np.split(way, jumps), R_grid_world, voxel or SPACE_VOXEL * depth, FARTHEST * depth)


def walls_of(run: FinishedRun, device: str, line: ProgressLine) -> tuple[TriangleMesh, float, float] | None:
    """Return what bounds the way of someone who walks in the map, and the heights of the floor and the cameras.

    They come from the map's own depth. Without a floor, or if the map is too large, there are none.
    """
    renderer, seen = _loaded(run, WALKED_SIDE, device, line), []
    places = camera_centres(run.poses)
    with line.working("looking for the floor and walls"):
        for index in run.spread(WALKED_VIEWS):
            camera, T = run.cameras[index].within(WALKED_SIDE), run.poses[index]
            depth = renderer.view(camera, T).expected_depth(LEAST_OPACITY).astype(np.float32)
            seen.append((camera, T, without_edges(depth)))
        try:
            space = _carved(run, seen, None)
        except ValueError:
            return None
        up = space.R_grid_world[2]
        height = float(np.median(places @ up))
        floor = space.floor(height)
        if floor is None:
            return None
        mesh = boundary(space, walkable(space, places, floor), WALKED_TRIANGLES)
        heights = run.gaussians["position"].astype(np.float64) @ up
        return mesh, float(np.median(heights[np.abs(heights - floor) <= space.voxel])), height


def _loaded(run: FinishedRun, longest: int, device: str, line: ProgressLine) -> MapRenderer:
    """Load the map for pictures of its frames with at most `longest` pixels on a side."""
    cameras = [run.cameras[index].within(longest) for index in run.mapped]
    with line.working("loading the map"):
        gaussians = run.gaussians
        start_device(device)
    width, height = max(camera.width for camera in cameras), max(camera.height for camera in cameras)
    return MapRenderer(gaussians, width, height, run.record.near)


def _surface_views(run: FinishedRun, renderer: MapRenderer, line: ProgressLine) -> list[SurfaceView]:
    """Return the surface's depth and colour from the mapped frames.

    The map's depth is corrected by matching the frames' images. If these are no longer available, renders of the map
    are matched instead, which are less sharp.
    """
    chosen = run.spread(SURFACE_VIEWS)
    grey: list[NDArray[np.uint8]] = []
    try:
        images = pictures(run, chosen, line.prepare)
        for image in line.through("reading images", images, len(chosen)):
            grey.append(_grey(eight_bits(image.image)))
    except InputError as error:
        grey = []
        line.note(f"note: matching the map's own pictures, since the images cannot be read: {error}")
    shown, views = [], []
    placed = [(run.cameras[index].within(LONGEST_SIDE), run.poses[index]) for index in chosen]
    for number, (camera, T) in enumerate(line.through("rendering", placed, len(placed))):
        view = renderer.view(camera, T)
        shown.append(eight_bits(view.colour))
        image = grey[number] if grey else _grey(shown[-1])
        image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        depth = view.expected_depth(LEAST_OPACITY).astype(np.float32)
        views.append(DepthView(camera, T, np.asarray(image / np.float32(255.0), dtype=np.float32), depth))
    matcher = DepthMatcher(views)
    matched = [matcher.matched(index) for index in line.through("matching images", range(len(views)), len(views))]
    joined = joined_depth(
        views, matched, matcher.neighbours, line.through("joining depth", range(len(views)), len(views))
    )
    return [
        SurfaceView(view.camera, view.T_camera_world, without_edges(depth), picture / np.float32(255.0))
        for view, depth, picture in zip(views, joined, shown, strict=True)
    ]


def _grey(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), dtype=np.uint8)

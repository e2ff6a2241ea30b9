"""Implements `modp-ti export`: writes a finished run in a given format."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import shifted_poses
from fields.geometry.se3 import camera_centres
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import list_files, refuse_foreign
from modp_ti.outputs.formats.collision import boundary, write_octomap, write_ros_map, write_voxels
from modp_ti.outputs.formats.compressed_splats import SPZ_VERSION, write_compressed_ply, write_spz, write_web_splat
from modp_ti.outputs.formats.dataset import image_names, new_folder, rename_images, write_image, write_transforms
from modp_ti.outputs.formats.gltf import write_splat_glb
from modp_ti.outputs.formats.mesh import (
    LEAST_OPACITY,
    MESH_SUFFIXES,
    TRUNCATION,
    SurfaceView,
    extracted,
    fused,
    supported,
    without_edges,
    write_mesh,
    write_points,
)
from modp_ti.outputs.formats.sog import write_sog, write_sog_lod
from modp_ti.outputs.formats.textured_mesh import painted, require_atlas, unwrapped, write_textured_mesh
from modp_ti.outputs.formats.tileset import write_tileset
from modp_ti.outputs.formats.usd import USD_SUFFIXES, write_usd
from modp_ti.outputs.measuring import Ruler, read_world
from modp_ti.outputs.playback.film import VIDEO_SUFFIXES, film, plan_flight
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.map_renderer import MapRenderer, eight_bits, start_device
from modp_ti.outputs.playback.plain_colours import with_plain_colours
from modp_ti.outputs.playback.run_frames import kept_images, pictures
from modp_ti.outputs.progress import ProgressLine
from modp_ti.outputs.report.page import show_link_to_map
from modp_ti.outputs.splat_page.page import (
    EYE_HEIGHT,
    levelled,
    moved,
    page_glb,
    viewer_settings,
    write_splat_page,
)
from pipelines.surface.depth import DepthMatcher, DepthView, joined_depth
from pipelines.surface.free_space import VoxelSpace, carved, reached, walkable
from pipelines.surface.fusion import Placed
from pipelines.whole.hierarchy import Hierarchy

if TYPE_CHECKING:
    from open3d.pybind.geometry import TriangleMesh

TEXTURED_NAME, PAGE = "mesh.glb", "map.html"
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


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export.

    Attributes:
        voxel: Edge of the voxels of a mesh or of free space [scene units], None for the default.
        texture: Whether the mesh gets a texture instead of a colour per vertex.
        device: Device for rendering.
        spz_version: Version of `.spz` to write, None for the default.
        height: Height above the floor of the slice of free space [scene units], None for that of the cameras.
        georeference: Whether a tileset that says where on the Earth the file is is written next to it.
    """

    voxel: float | None = None
    texture: bool = False
    device: str = "auto"
    spz_version: int | None = None
    height: float | None = None
    georeference: bool = False

    def require_used(self, format: str) -> None:
        """Raise InputError if an option is given that the format ignores."""
        given = {
            "voxel": (("mesh", "collision"), self.voxel),
            "texture": (("mesh",), self.texture),
            "spz-version": (("spz",), self.spz_version),
            "height": (("collision",), self.height),
            "georeference": (("splat-glb", "mesh"), self.georeference),
        }
        for option, (of, value) in given.items():
            if value and format not in of:
                raise InputError(f"--{option}: --format {format} has none; use --format {of[0]}, or leave it out")


@dataclass(frozen=True)
class Format:
    """A format of `modp-ti export`.

    Attributes:
        name: Default name in the run's folder.
        write: Writes a run to a file or a new folder, and shows its progress.
        suffixes: Suffixes of its files; none for a folder.
    """

    name: str
    write: Callable[[FinishedRun, Path, ExportOptions, ProgressLine], None]
    suffixes: tuple[str, ...] = ()


def export_map(run: FinishedRun, format: str, output: Path | None, options: ExportOptions, line: ProgressLine) -> Path:
    """Write a run in one of the FORMATS.

    Args:
        run: The finished run.
        format: Name of the format.
        output: File or new folder, None for the default name in the run's folder.
        options: Options of the export.
        line: Shows the progress.

    Returns:
        The path that was written.

    Raises:
        InputError: If the export is not possible.
    """
    options.require_used(format)
    form = FORMATS[format]
    suffixes = (".glb",) if options.texture else form.suffixes
    origin = read_world(run.folder).get("origin")
    if options.georeference and origin is None:
        raise InputError(f"{run.folder}: its place on the Earth is not known: `modp-ti scale --gps` finds it")
    listed = output is None and bool(suffixes)  # belongs to the run
    target = run.folder / (TEXTURED_NAME if options.texture else form.name) if output is None else output.expanduser()
    if suffixes and (target.is_dir() or target.suffix.lower() not in suffixes):
        raise InputError(f"{target}: name a file in {', '.join(suffixes)}, for example {form.name}")
    if target.resolve() == (run.folder / "splats.ply").resolve():
        raise InputError(f"{target}: is the map itself; name another file")
    if options.georeference and target.suffix.lower() != ".glb":
        raise InputError(f"{target}: --georeference is for glTF: name a .glb file (-o)")
    tileset = target.with_suffix(".tileset.json")
    written = [target.name, *([tileset.name] if options.georeference else [])]
    if listed:
        refuse_foreign(run.folder, written)
    if options.texture:
        require_atlas()
    try:
        target.absolute().parent.mkdir(parents=True, exist_ok=True)
        form.write(run, target, options, line)
        if options.georeference and origin is not None:
            place = np.array([origin[name] for name in ("latitude", "longitude", "height")])
            xyz = run.gaussians["position"].astype(np.float64)
            write_tileset(tileset, target, place, run.record.origin, np.stack([xyz.min(axis=0), xyz.max(axis=0)]))
        if listed:
            list_files(run.folder, written)
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror or error}; name another place") from None
    return target


# ---- points, splats, pages, data sets, videos --------------------------------------------------------------------


def _points(run: FinishedRun, target: Path, options: ExportOptions, line: ProgressLine) -> None:
    with line.working("writing points"):
        write_points(target, run.gaussians, run.record.origin)


def _splats(write: Callable[[Path, dict[str, NDArray[np.float32]]], object]) -> Callable[..., None]:
    def splats(run: FinishedRun, target: Path, options: ExportOptions, line: ProgressLine) -> None:
        with line.working("writing splats"):
            write(target, run.gaussians)

    return splats


def _plain_splats(run: FinishedRun, target: Path, options: ExportOptions, line: ProgressLine) -> None:
    start_device(options.device)
    write_web_splat(target, with_plain_colours(run, line))


def _spz(run: FinishedRun, target: Path, options: ExportOptions, line: ProgressLine) -> None:
    with line.working("writing splats"):
        note = write_spz(target, run.gaussians, options.spz_version or SPZ_VERSION)
    if note:
        line.note(f"note: {note}")


def _page(run: FinishedRun, target: Path, options: ExportOptions, line: ProgressLine) -> None:
    """Write the page, and show the link to it in the run's report if it lies next to it under its default name."""
    upright, ruler = levelled(run), Ruler.of(run)
    walls = _walls(run, options.device, line)
    with line.working("writing the page"):
        if walls is not None and ruler.unit != "m":
            upright = replace(upright, scale=EYE_HEIGHT / (walls[2] - walls[1]))
        floor = None if walls is None else upright.scale * walls[1]
        world = {"unit": ruler.unit, "scale": 1.0 / upright.scale, "deviation": ruler.deviation, "floor": floor}
        state = moved(run.gaussians, upright.R, upright.scale)
        shape = None if walls is None else page_glb(walls[0], upright)
        write_splat_page(target, run.folder.absolute().name, viewer_settings(run, upright), state, world, shape)
        if target.resolve() == (run.folder / PAGE).resolve():
            show_link_to_map(run.folder / "report.html")


def _levels_of_detail(run: FinishedRun, target: Path, options: ExportOptions, line: ProgressLine) -> None:
    """Write the map at all levels of detail, upright as in the page, with a page that streams it."""
    with line.working("writing levels of detail"):
        upright = levelled(run)
        hierarchy = Hierarchy(moved(run.gaussians, upright.R, upright.scale))
        with new_folder(target) as folder:
            write_sog_lod(folder, hierarchy)
            write_splat_page(folder / "index.html", run.folder.absolute().name, viewer_settings(run, upright))


def _colmap(run: FinishedRun, target: Path, options: ExportOptions, line: ProgressLine) -> None:
    with new_folder(target) as folder:
        names = _write_images(run, folder, line)
        rename_images(run.folder / "colmap", folder / "sparse" / "0", names)


def _nerfstudio(run: FinishedRun, target: Path, options: ExportOptions, line: ProgressLine) -> None:
    with new_folder(target) as folder:
        names = _write_images(run, folder, line)
        write_points(folder / "points.ply", run.gaussians, run.record.origin)
        poses = list(shifted_poses(run.poses, run.record.origin))
        write_transforms(folder, names, run.cameras, poses, run.record.held_out, "points.ply")


def _write_images(run: FinishedRun, folder: Path, line: ProgressLine) -> list[str]:
    """Write all undistorted images and masks of the run to a folder, and return the names of the images."""
    names = run.names if kept_images(run) is not None else image_names(run.names, written=True)
    for name, picture in zip(
        names, line.through("reading images", pictures(run, None, line.prepare), len(run)), strict=True
    ):
        write_image(folder, name, picture)
    return names


def _video(run: FinishedRun, target: Path, options: ExportOptions, line: ProgressLine) -> None:
    film(run, plan_flight(run, "recorded"), target, "colour", options.device, line)


# ---- the mesh ----------------------------------------------------------------------------------------------------


def _mesh(run: FinishedRun, target: Path, options: ExportOptions, line: ProgressLine) -> None:
    voxel = options.voxel or VOXEL * run.record.scene_depth
    longest = LONGEST_PAINTED_SIDE if options.texture else LONGEST_SIDE
    renderer = _loaded(run, longest, options.device, line)
    views = _surface_views(run, renderer, line)
    with line.working("fusing depth"):
        grid = fused(views, voxel, FARTHEST * run.record.scene_depth)
    with line.working("extracting the surface"):
        mesh = supported(extracted(grid), views, TRUNCATION * voxel)
    if options.texture:
        with line.working("unwrapping the surface"):
            flat = unwrapped(mesh)
        places = [(run.cameras[index].within(longest), run.poses[index]) for index in run.spread(PAINTED_VIEWS)]
        shots = ((*place, renderer.view(*place).colour) for place in line.through("painting", places, len(places)))
        write_textured_mesh(target, painted(flat, shots))
        return
    if target.suffix.lower() == ".ply" and run.record.origin.any():  # its coordinates are double
        mesh.translate(run.record.origin)
    write_mesh(target, mesh)


def _collision(run: FinishedRun, target: Path, options: ExportOptions, line: ProgressLine) -> None:
    """Write what is free and what is solid, in axes whose z points up."""
    with new_folder(target) as folder:
        views = _surface_views(run, _loaded(run, LONGEST_SIDE, options.device, line), line)
        seen = [(view.camera, view.T_camera_world, view.depth) for view in views]
        with line.working("carving space"):
            try:
                space = _carved(run, seen, options.voxel)
            except ValueError as error:
                raise InputError(f"{error}; use larger ones (--voxel)") from None
        places = camera_centres(run.poses)
        height = float(np.median(places @ space.R_grid_world[2]))
        floor = space.floor(height)
        if options.height is not None:
            if floor is None:
                raise InputError("--height: no floor was seen below the cameras; leave it out for the cameras' height")
            height = floor + options.height
        with line.working("extracting the surface"):
            write_voxels(folder / "voxels.npz", space, run.record.origin, floor)
            write_ros_map(folder, space, height)
            write_octomap(folder / "voxels.bt", space)
            write_mesh(folder / "mesh.glb", boundary(space, reached(space, places)))


def _carved(run: FinishedRun, seen: Sequence[Placed], voxel: float | None) -> VoxelSpace:
    """Carve space with depth maps of a run. Raises ValueError if there would be too many voxels."""
    depth, R = run.record.scene_depth, levelled(run).R
    way = camera_centres(run.poses)[run.way]
    jumps = np.flatnonzero(np.linalg.norm(np.diff(way, axis=0), axis=1) > JUMP * depth) + 1
    R_grid_world = np.stack([R[0], R[2], -R[1]])
    return carved(seen, np.split(way, jumps), R_grid_world, voxel or SPACE_VOXEL * depth, FARTHEST * depth)


def _walls(run: FinishedRun, device: str, line: ProgressLine) -> tuple[TriangleMesh, float, float] | None:
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


FORMATS = {
    "points": Format("points.ply", _points, (".ply",)),
    "mesh": Format("mesh.ply", _mesh, MESH_SUFFIXES),
    "collision": Format("collision", _collision),
    "splat": Format("splats.splat", _plain_splats, (".splat",)),
    "spz": Format("splats.spz", _spz, (".spz",)),
    "sog": Format("splats.sog", _splats(write_sog), (".sog",)),
    "sog-lod": Format("splats-lod", _levels_of_detail),
    "compressed-ply": Format("splats.compressed.ply", _splats(write_compressed_ply), (".ply",)),
    "splat-glb": Format("splats.glb", _splats(write_splat_glb), (".glb",)),
    "usd": Format("splats.usdc", _splats(write_usd), USD_SUFFIXES),
    "html": Format(PAGE, _page, (".html",)),
    "colmap": Format("colmap-dataset", _colmap),
    "nerfstudio": Format("nerfstudio", _nerfstudio),
    "video": Format("recorded.mp4", _video, tuple(VIDEO_SUFFIXES)),
}
"""The formats by name."""

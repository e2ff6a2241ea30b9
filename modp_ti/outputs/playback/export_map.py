"""Implements `modp-ti export`: writes a finished run in a given format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import shifted_poses
from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import list_files, refuse_foreign
from modp_ti.outputs.formats.compressed_ply import write_compressed_ply
from modp_ti.outputs.formats.dataset import new_folder, rename_images, write_transforms
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
)
from modp_ti.outputs.formats.points_ply import write_points
from modp_ti.outputs.formats.sog import write_sog, write_sog_lod
from modp_ti.outputs.formats.spz import DEFAULT_VERSION, write_spz
from modp_ti.outputs.formats.textured_mesh import painted, require_atlas, unwrapped
from modp_ti.outputs.formats.web_splat import write_web_splat
from modp_ti.outputs.playback.film import VIDEO_SUFFIXES, film, plan_flight
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.map_renderer import MapRenderer, eight_bits, start_device
from modp_ti.outputs.playback.mapped_images import dataset_names, grey_images, write_images
from modp_ti.outputs.playback.plain_colours import with_plain_colours
from modp_ti.outputs.progress import ProgressLine
from modp_ti.outputs.report.page import show_link_to_map
from modp_ti.outputs.splat_page.page import level, moved, viewer_settings, write_splat_page, write_streaming_page
from pipelines.surface.depth import DepthMatcher, DepthView, joined_depth
from pipelines.whole.hierarchy import Hierarchy

TEXTURED_NAME, PAGE = "mesh.glb", "map.html"
# Edge of the mesh's voxels, and largest depth that is fused, both relative to the scene's depth.
VOXEL, FARTHEST = 1 / 160, 4.0
# Most views that are fused, evenly spaced over the frames, and their longer side [px]. A pixel is then finer than the
# mesh's voxels. The same of the pictures that a texture is painted from.
SURFACE_VIEWS, LONGEST_SIDE = 300, 480
PAINTED_VIEWS, LONGEST_PAINTED_SIDE = 100, 1024

Placed = tuple[PinholeCamera, NDArray[np.float64]]


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export.

    Attributes:
        voxel: Edge of the mesh's voxels [scene units], None for VOXEL times the scene's depth.
        texture: Whether the mesh gets a texture instead of a colour per vertex.
        device: Device for rendering.
        spz_version: Version of `.spz` to write, None for the default.
    """

    voxel: float | None = None
    texture: bool = False
    device: str = "auto"
    spz_version: int | None = None

    def require_used(self, format: str) -> None:
        """Raise InputError if an option is given that the format ignores."""
        for option, given, of in (("voxel", self.voxel, "mesh"), ("spz-version", self.spz_version, "spz")):
            if given is not None and format != of:
                raise InputError(f"--{option}: --format {format} has none; use --format {of}, or leave it out")


@dataclass(frozen=True)
class Export:
    """A run on its way to a file or folder.

    Attributes:
        run: The finished run.
        target: The file, or the new folder.
        options: Options of the export.
        line: Shows the progress.
    """

    run: FinishedRun
    target: Path
    options: ExportOptions
    line: ProgressLine


@dataclass(frozen=True)
class Format:
    """A format of `modp-ti export`.

    Attributes:
        name: Default name in the run's folder.
        write: Writes it.
        suffixes: Suffixes of its files; none for a folder.
    """

    name: str
    write: Callable[[Export], None]
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
    form = FORMATS[format]
    listed = output is None and bool(form.suffixes)  # belongs to the run
    if options.texture:
        if format != "mesh":
            raise InputError(f"--texture: --format {format} has no texture; use --format mesh")
        output = run.folder / TEXTURED_NAME if output is None else output
    target = run.folder / form.name if output is None else output.expanduser()
    if form.suffixes:
        _require_file(run, target, format)
    if listed:
        refuse_foreign(run.folder, [target.name])
    if options.texture:
        if target.suffix.lower() != ".glb":
            raise InputError(f"{target}: a mesh with --texture is written as .glb")
        require_atlas()
    parent = target.absolute().parent
    try:
        parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{parent}: cannot be made: {error.strerror or error}; name another folder") from None
    try:
        form.write(Export(run, target, options, line))
        if listed:
            list_files(run.folder, [target.name])
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror or error}") from None
    return target


def _require_file(run: FinishedRun, target: Path, format: str) -> None:
    """Raise InputError if the output file is not usable, before anything is computed."""
    form = FORMATS[format]
    if target.is_dir():
        raise InputError(f"{target}: is a folder; name a file, for example {target / form.name}")
    if target.suffix.lower() not in form.suffixes:
        raise InputError(f"{target}: --format {format} writes a file in {', '.join(form.suffixes)}")
    if target.resolve() == (run.folder / "splats.ply").resolve():
        raise InputError(f"{target}: is the map itself; name another file")


# ---- points, splats, pages, data sets, videos --------------------------------------------------------------------


def _points(export: Export) -> None:
    with export.line.working("writing points"):
        write_points(export.target, export.run.gaussians, export.run.record.origin)


def _splats(write: Callable[[Path, dict[str, NDArray[np.float32]]], object]) -> Callable[[Export], None]:
    def splats(export: Export) -> None:
        with export.line.working("writing splats"):
            write(export.target, export.run.gaussians)

    return splats


def _plain_splats(export: Export) -> None:
    start_device(export.options.device)
    write_web_splat(export.target, with_plain_colours(export.run, export.line))


def _spz(export: Export) -> None:
    with export.line.working("writing splats"):
        note = write_spz(export.target, export.run.gaussians, export.options.spz_version or DEFAULT_VERSION)
    if note:
        export.line.note(f"note: {note}")


def _page(export: Export) -> None:
    """Write the page, and show the link to it in the run's report if it lies next to it under its default name."""
    run, target = export.run, export.target
    with export.line.working("writing the page"):
        upright = level(run.poses, run.record.scene_depth)
        state = moved(run.gaussians, upright.R, upright.scale)
        write_splat_page(target, run.folder.absolute().name, state, viewer_settings(run, upright))
        if target.resolve() == (run.folder / PAGE).resolve():
            show_link_to_map(run.folder / "report.html")


def _levels_of_detail(export: Export) -> None:
    """Write the map at all levels of detail, upright as in the page, with a page that streams it."""
    run = export.run
    with export.line.working("writing levels of detail"):
        upright = level(run.poses, run.record.scene_depth)
        hierarchy = Hierarchy(moved(run.gaussians, upright.R, upright.scale))
        with new_folder(export.target) as folder:
            write_sog_lod(folder, hierarchy)
            write_streaming_page(folder / "index.html", run.folder.absolute().name, viewer_settings(run, upright))


def _colmap(export: Export) -> None:
    run, names = export.run, dataset_names(export.run)
    with new_folder(export.target) as folder:
        write_images(run, folder, export.line)
        rename_images(run.folder / "colmap", folder / "sparse" / "0", names)


def _nerfstudio(export: Export) -> None:
    run, names = export.run, dataset_names(export.run)
    with new_folder(export.target) as folder:
        write_images(run, folder, export.line)
        write_points(folder / "points.ply", run.gaussians, run.record.origin)
        poses = list(shifted_poses(run.poses, run.record.origin))
        write_transforms(folder, names, run.cameras, poses, run.record.held_out, "points.ply")


def _video(export: Export) -> None:
    film(export.run, plan_flight(export.run, "recorded"), export.target, False, export.options.device, export.line)


# ---- the mesh ----------------------------------------------------------------------------------------------------


def _mesh(export: Export) -> None:
    run, target, options, line = export.run, export.target, export.options, export.line
    voxel = options.voxel or VOXEL * run.record.scene_depth
    with line.working("loading the map"):
        gaussians = run.gaussians
        start_device(options.device)
    renderer = MapRenderer(gaussians, *_largest_view(run, options.texture), run.record.near)
    views = _surface_views(run, renderer, line)
    with line.working("fusing depth"):
        grid = fused(views, voxel, FARTHEST * run.record.scene_depth)
    with line.working("extracting the surface"):
        mesh = supported(extracted(grid), views, TRUNCATION * voxel)
    if options.texture:
        with line.working("unwrapping the surface"):
            flat = unwrapped(mesh)
        places = _painted_from(run)
        mesh = painted(flat, ((*p, renderer.view(*p).colour) for p in line.through("painting", places, len(places))))
    elif target.suffix.lower() == ".ply" and run.record.origin.any():  # its coordinates are double
        mesh.translate(run.record.origin)
    write_mesh(target, mesh)


def _surface_views(run: FinishedRun, renderer: MapRenderer, line: ProgressLine) -> list[SurfaceView]:
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


def _painted_from(run: FinishedRun) -> list[Placed]:
    """Return camera and T_camera_world (4, 4) of the pictures to paint a texture from."""
    chosen = run.spread(PAINTED_VIEWS)
    return [(_within(run.cameras[index], LONGEST_PAINTED_SIDE), run.poses[index]) for index in chosen]


def _largest_view(run: FinishedRun, texture: bool) -> tuple[int, int]:
    """Return width and height of the largest views that are rendered for a mesh [px]."""
    longest = LONGEST_PAINTED_SIDE if texture else LONGEST_SIDE
    cameras = [_within(run.cameras[index], longest) for index in run.mapped]
    return max(camera.width for camera in cameras), max(camera.height for camera in cameras)


def _within(camera: PinholeCamera, longest: int) -> PinholeCamera:
    """Return the camera for the same view with at most `longest` pixels on a side."""
    s = min(1.0, longest / max(camera.width, camera.height))
    return camera.resized(max(round(s * camera.width), 1), max(round(s * camera.height), 1))


FORMATS = {
    "points": Format("points.ply", _points, (".ply",)),
    "mesh": Format("mesh.ply", _mesh, MESH_SUFFIXES),
    "splat": Format("splats.splat", _plain_splats, (".splat",)),
    "spz": Format("splats.spz", _spz, (".spz",)),
    "sog": Format("splats.sog", _splats(write_sog), (".sog",)),
    "sog-lod": Format("splats-lod", _levels_of_detail),
    "compressed-ply": Format("splats.compressed.ply", _splats(write_compressed_ply), (".ply",)),
    "splat-glb": Format("splats.glb", _splats(write_splat_glb), (".glb",)),
    "html": Format(PAGE, _page, (".html",)),
    "colmap": Format("colmap-dataset", _colmap),
    "nerfstudio": Format("nerfstudio", _nerfstudio),
    "video": Format("recorded.mp4", _video, tuple(VIDEO_SUFFIXES)),
}
"""The formats by name."""

"""Implements `modp-ti export`: writes a finished run in a given format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import shifted_poses
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import list_files, refuse_foreign
from modp_ti.outputs.formats.compressed_splats import SPZ_VERSION, write_compressed_ply, write_spz, write_web_splat
from modp_ti.outputs.formats.dataset import image_names, new_folder, rename_images, write_image, write_transforms
from modp_ti.outputs.formats.gltf import write_splat_glb
from modp_ti.outputs.formats.mesh import (
    MESH_SUFFIXES,
    write_points,
)
from modp_ti.outputs.formats.sog import write_sog, write_sog_lod
from modp_ti.outputs.formats.textured_mesh import require_atlas
from modp_ti.outputs.formats.tileset import write_tileset
from modp_ti.outputs.formats.usd import USD_SUFFIXES, write_usd
from modp_ti.outputs.measuring import Ruler, read_world
from modp_ti.outputs.playback.film import VIDEO_SUFFIXES, film, plan_flight
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.map_renderer import start_device
from modp_ti.outputs.playback.plain_colours import with_plain_colours
from modp_ti.outputs.playback.run_frames import kept_images, pictures
from modp_ti.outputs.playback.surfaces import export_collision, export_mesh, walls_of
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
from pipelines.whole.hierarchy import Hierarchy

if TYPE_CHECKING:
    pass

TEXTURED_NAME, PAGE = "mesh.glb", "map.html"


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


# ---- points, splats, pages, data sets, surfaces, videos ----------------------------------------------------------


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
    walls = walls_of(run, options.device, line)
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


def _mesh(run: FinishedRun, target: Path, options: ExportOptions, line: ProgressLine) -> None:
    export_mesh(run, target, options.voxel, options.texture, options.device, line)


def _collision(run: FinishedRun, target: Path, options: ExportOptions, line: ProgressLine) -> None:
    export_collision(run, target, options.voxel, options.height, options.device, line)


def _video(run: FinishedRun, target: Path, options: ExportOptions, line: ProgressLine) -> None:
    film(run, plan_flight(run, "recorded"), target, "colour", options.device, line)


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

"""Implements `modp-ti export`: writes a finished run in a given format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fields.frames.origin import shifted_poses
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import list_files, refuse_foreign
from modp_ti.outputs.formats.compressed_ply import write_compressed_ply
from modp_ti.outputs.formats.dataset import new_folder, rename_images, write_transforms
from modp_ti.outputs.formats.gltf import write_splat_glb
from modp_ti.outputs.formats.mesh import MESH_SUFFIXES, TRUNCATION, extracted, fused, supported, write_mesh
from modp_ti.outputs.formats.points_ply import write_points
from modp_ti.outputs.formats.sog import write_sog, write_sog_lod
from modp_ti.outputs.formats.spz import DEFAULT_VERSION, write_spz
from modp_ti.outputs.formats.textured_mesh import painted, require_atlas, unwrapped
from modp_ti.outputs.formats.web_splat import write_web_splat
from modp_ti.outputs.playback.film import is_video
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.flight import film, plan_flight
from modp_ti.outputs.playback.map_renderer import MapRenderer, start_device
from modp_ti.outputs.playback.mapped_images import dataset_names, write_images
from modp_ti.outputs.playback.plain_colours import with_plain_colours
from modp_ti.outputs.playback.surface import largest_view, painted_from, surface_views
from modp_ti.outputs.progress import ProgressLine
from modp_ti.outputs.report.page import show_link_to_map
from modp_ti.outputs.splat_page.flight import level, moved, viewer_settings
from modp_ti.outputs.splat_page.page import write_splat_page, write_streaming_page
from pipelines.whole.hierarchy import Hierarchy

__all__ = ["DEFAULT_NAMES", "export_map"]

# Default output name of each format, in the run's folder.
DEFAULT_NAMES = {
    "points": "points.ply",
    "mesh": "mesh.ply",
    "splat": "splats.splat",
    "spz": "splats.spz",
    "sog": "splats.sog",
    "sog-lod": "splats-lod",
    "compressed-ply": "splats.compressed.ply",
    "splat-glb": "splats.glb",
    "html": "map.html",
    "colmap": "colmap-dataset",
    "nerfstudio": "nerfstudio",
    "video": "recorded.mp4",
}
SPLATS = {"sog": write_sog, "compressed-ply": write_compressed_ply, "splat-glb": write_splat_glb}
# Formats that are written to a folder.
FOLDERS = ("colmap", "nerfstudio", "sog-lod")
TEXTURED_NAME = "mesh.glb"
# Edge of the mesh's voxels, and largest depth that is fused, both relative to the scene's depth.
VOXEL = 1 / 160
FARTHEST = 4.0


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


def export_map(run: FinishedRun, format: str, output: Path | None, options: ExportOptions, line: ProgressLine) -> Path:
    """Write a run in one of the formats of DEFAULT_NAMES.

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
    default = output is None and format not in FOLDERS
    if options.texture:
        if format != "mesh":
            raise InputError(f"--texture: --format {format} has no texture; use --format mesh")
        output = run.folder / TEXTURED_NAME if output is None else output
    target = _target(run, format, output)
    if default:
        refuse_foreign(run.folder, [target.name])
    if options.texture:
        if target.suffix.lower() != ".glb":
            raise InputError(f"{target}: a mesh with --texture is written as .glb")
        require_atlas()
    _make_folder(target.absolute().parent)
    try:
        if format == "points":
            with line.working("writing points"):
                write_points(target, run.gaussians, run.record.origin)
        elif format == "mesh":
            _mesh(run, target, options, line)
        elif format == "splat":
            start_device(options.device)
            write_web_splat(target, with_plain_colours(run, line))
        elif format == "spz":
            with line.working("writing splats"):
                note = write_spz(target, run.gaussians, options.spz_version or DEFAULT_VERSION)
            if note:
                line.note(f"note: {note}")
        elif format in SPLATS:
            with line.working("writing splats"):
                SPLATS[format](target, run.gaussians)
        elif format == "html":
            with line.working("writing the page"):
                _page(run, target)
        elif format == "sog-lod":
            with line.working("writing levels of detail"):
                _levels_of_detail(run, target)
        elif format == "video":
            film(run, plan_flight(run, "recorded"), target, False, options.device, line)
        else:
            _dataset(run, target, format, line)
        if default:
            list_files(run.folder, [target.name])
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror or error}") from None
    return target


def _target(run: FinishedRun, format: str, output: Path | None) -> Path:
    """Return the output path. Raises InputError if it is not usable, before anything is computed."""
    target = run.folder / DEFAULT_NAMES[format] if output is None else output.expanduser()
    if format in FOLDERS:
        return target
    if target.is_dir():
        raise InputError(f"{target}: is a folder; name a file, for example {target / DEFAULT_NAMES[format]}")
    wanted = {"mesh": MESH_SUFFIXES, "points": (".ply",), "compressed-ply": (".ply",), "splat-glb": (".glb",)}.get(
        format, (f".{format}",)
    )
    if format == "video":
        if not is_video(target):
            raise InputError(f"{target}: a video's name ends in .mp4 or .webm")
    elif target.suffix.lower() not in wanted:
        raise InputError(f"{target}: --format {format} writes a file in {', '.join(wanted)}")
    if target.resolve() == (run.folder / "splats.ply").resolve():
        raise InputError(f"{target}: is the map itself; name another file")
    return target


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made: {error.strerror or error}; name another folder") from None


def _mesh(run: FinishedRun, target: Path, options: ExportOptions, line: ProgressLine) -> None:
    voxel = options.voxel or VOXEL * run.record.scene_depth
    with line.working("loading the map"):
        gaussians = run.gaussians
        start_device(options.device)
    renderer = MapRenderer(gaussians, *largest_view(run, options.texture), run.record.near)
    views = surface_views(run, renderer, line)
    with line.working("fusing depth"):
        grid = fused(views, voxel, FARTHEST * run.record.scene_depth)
    with line.working("extracting the surface"):
        mesh = supported(extracted(grid), views, TRUNCATION * voxel)
    if options.texture:
        with line.working("unwrapping the surface"):
            flat = unwrapped(mesh)
        places = painted_from(run)
        mesh = painted(flat, ((*p, renderer.view(*p).colour) for p in line.through("painting", places, len(places))))
    elif target.suffix.lower() == ".ply" and run.record.origin.any():  # its coordinates are double
        mesh.translate(run.record.origin)
    write_mesh(target, mesh)


def _page(run: FinishedRun, target: Path) -> None:
    """Write the page, and show the link to it in the run's report if it lies beside it under its default name."""
    upright = level(run.poses, run.record.scene_depth)
    state = moved(run.gaussians, upright.R, upright.scale)
    write_splat_page(target, run.folder.absolute().name, state, viewer_settings(run, upright))
    if target.resolve() == (run.folder / DEFAULT_NAMES["html"]).resolve():
        show_link_to_map(run.folder / "report.html")


def _levels_of_detail(run: FinishedRun, target: Path) -> None:
    """Write the map at all levels of detail, upright as in the page, with a page that streams it."""
    upright = level(run.poses, run.record.scene_depth)
    hierarchy = Hierarchy(moved(run.gaussians, upright.R, upright.scale))
    with new_folder(target) as folder:
        write_sog_lod(folder, hierarchy)
        write_streaming_page(folder / "index.html", run.folder.absolute().name, viewer_settings(run, upright))


def _dataset(run: FinishedRun, target: Path, format: str, line: ProgressLine) -> None:
    names = dataset_names(run)
    with new_folder(target) as folder:
        write_images(run, folder, line)
        if format == "colmap":
            rename_images(run.folder / "colmap", folder / "sparse" / "0", names)
        else:
            write_points(folder / "points.ply", run.gaussians, run.record.origin)
            poses = list(shifted_poses(run.poses, run.record.origin))
            write_transforms(folder, names, run.cameras, poses, run.record.held_out, "points.ply")

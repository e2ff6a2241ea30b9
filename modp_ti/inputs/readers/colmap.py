"""Kind `colmap`: poses and points of a binary or text COLMAP model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from fields.frames.tracked_frame import SparsePoints
from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.files.trajectory import FARTHEST, checked_pose
from modp_ti.inputs.colmap_model import ColmapModel, ModelCamera, ModelImage, image_count, read_colmap_model
from modp_ti.inputs.given_poses import (
    PANORAMAS,
    checked_reader,
    matched_entries,
    missing_frames_note,
    selected_frames,
    solving,
    triangulated_views,
)
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.point_cloud import spread_points
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.reader import GivenPosesSettings, RecordedSettings
from modp_ti.inputs.replay import PosedImage, ReplayedTracker, points_inside
from modp_ti.inputs.sources import Distortion, ImageSource
from modp_ti.inputs.sources.distortion import colmap_intrinsics
from modp_ti.inputs.sources.intrinsics import require_plausible
from modp_ti.inputs.sources.orientation import Turn
from modp_ti.inputs.stored_cameras import StoredView, stored_frames

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig, SourceSettings

TOPS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")

# Most points that a frame gets of a model whose images observe none.
MOST_PROJECTED: int = GivenPosesSettings.model_fields["max_points"].default


class ColmapSettings(RecordedSettings):
    """A COLMAP model, binary or text."""

    brings_cameras: ClassVar[bool] = True
    pose_files: ClassVar[Sequence[str]] = tuple(f"{top}/images.*" for top in TOPS)

    kind: Literal["colmap"] = Field(default="colmap", description="a COLMAP model")
    path: Path | None = Field(
        default=None,
        description="folder with cameras, images and points3D, or the parent of such a folder `0`; empty: `sparse/0` "
        "or `sparse`, next to the images' folder or in it",
    )

    def open(self, scene: SceneConfig, progress: Progress | None = None) -> ReplayedTracker:
        """Open the images that have a pose in the model, in natural order; see `open_model`."""
        return open_model(scene.source, self.path, progress)

    @classmethod
    def poses_of(cls, path: Path) -> tuple[dict[str, Any], Path] | None:
        found = super().poses_of(path)
        return None if found is None else ({"path": str(found[1].parent)}, found[1])


def open_model(
    source: SourceSettings, given: Path | None, progress: Progress | None = None, upright: bool = False
) -> ReplayedTracker:
    """Open the images that have a pose in the model, in natural order, with the points that each observes.

    Where no image observes any, each gets the points of the model that project into it. Where the model has none, they
    are triangulated before the first frame is delivered.

    Args:
        source: Settings of the images.
        given: Folder of the model, or of models; None for the usual places.
        progress: Called while points are triangulated.
        upright: Whether the model was made from the images turned as their EXIF orientation says. Otherwise the sizes
            of its cameras tell.

    Raises:
        InputError: If the model is missing or damaged, has an unsupported camera model, has no image in the folder, or
            if images do not match their cameras.
    """
    place = source.require_path()
    images = open_source(source)
    folder, notes = _model_folder(place, given)
    model = read_colmap_model(folder, posed_alone=True)
    if not model.images:
        raise InputError(f"{folder}: the COLMAP model holds no image")
    stated = [(image.name, image) for image in model.images.values()]
    if len(images.mounts) > 1:
        posed, more = _posed_faces(images, source, dict(stated), folder)
    else:
        posed, more = matched_entries(images, source, stated, folder, str(folder), "images")
    cameras = {number: _camera(number, camera, folder) for number, camera in model.cameras.items()}
    views = {
        name: StoredView(*cameras[image.camera], checked_pose(image.T_camera_world, f"{folder}: image {image.name}"))
        for name, image in posed.items()
    }
    frames, turns, turned = stored_frames(images, views, str(folder), upright)
    reader = checked_reader(images, source, {frame.name: frame.undistorter for frame in frames}, str(folder))

    near, count = np.abs(model.xyz).max(axis=1, initial=0.0) <= FARTHEST, len(model.ids)
    ids, xyz = model.ids[near], model.xyz[near]
    notes += [*more, *turned]
    if len(ids) < count:
        notes.append(f"{count - len(ids)} of {count} points of {folder} are NaN or infinite: left out")
    if count or any((folder / f"points3D{suffix}").exists() for suffix in (".bin", ".txt")):
        pairs = zip(frames, turns, posed.values(), strict=True)
        frames = [frame.with_points(_observed(image, model, frame, turn)) for frame, turn, image in pairs]
    if not any(len(frame.points) for frame in frames):
        if len(ids):
            frames = [frame.with_points(spread_points(xyz, ids, frame, MOST_PROJECTED)) for frame in frames]
            notes.append(f"no image of {folder} observes a point: each gets those that project into it")
        if not any(len(frame.points) for frame in frames):
            notes.append(f"the images of {folder} see none of its {count} points: triangulated instead")
            frames = triangulated_views(images, frames, solving(frames, source), progress)
    return ReplayedTracker(reader, frames, notes)


def _posed_faces(
    images: ImageSource, source: SourceSettings, stated: dict[str, ModelImage], folder: Path
) -> tuple[dict[str, ModelImage], list[str]]:
    """Match the images of a model of faces with the selected panoramas, all of whose faces have a pose or none."""
    selected = selected_frames(images, source)
    posed = {face: stated[face] for name in selected for face in images.views(name) if face in stated}
    whole = {name: None for name in selected if images.views(name)[0] in posed}
    return posed, missing_frames_note(selected, whole, str(folder))


def _model_folder(images: Path, given: Path | None) -> tuple[Path, list[str]]:
    """Return the folder with cameras, images and points3D, and a remark if it was chosen of several.

    COLMAP writes a model to each of the folders 0, 1, ... where it cannot join all images. That of most images is used.
    """
    roots = [given] if given is not None else [images.parent / "sparse", images / "sparse"]
    for root in roots:
        numbered = [root / "0", *sorted((f for f in root.glob("[0-9]*") if f.name != "0"), key=lambda f: f.name)]
        own = [root] if _is_model(root) else []
        parts = list(filter(_is_model, numbered))
        if own and (given is not None or not parts):
            return root, []
        if parts:
            counts = {folder: image_count(folder) for folder in parts} if len(parts) > 1 else {parts[0]: 0}
            best = max(counts, key=lambda folder: counts[folder])
            said = ", ".join(f"{folder.name} with {count} images" for folder, count in counts.items())
            return best, [f"{root} holds several models, {said}: {best.name} is used"] if len(parts) > 1 else []
    if given is None:
        raise InputError(f"no COLMAP model in {images.parent / 'sparse'} or its folder 0: set tracker.path")
    if not given.exists():
        raise InputError(f"{given}: no such folder (tracker.path); it should hold a COLMAP model")
    raise InputError(f"{given}: holds no COLMAP model (cameras, images and points3D as .bin or .txt)")


def _is_model(folder: Path) -> bool:
    return any((folder / f"cameras{suffix}").exists() for suffix in (".bin", ".txt"))


def _camera(number: int, camera: ModelCamera, folder: Path) -> tuple[PinholeCamera, Distortion]:
    if camera.model == "EQUIRECTANGULAR":
        raise InputError(f"{folder}: {PANORAMAS}")
    intrinsics = colmap_intrinsics(camera.model, camera.params)
    if intrinsics is None:
        raise InputError(
            f"{folder}: camera model {camera.model[:40]} is not supported; run `colmap image_undistorter` first"
        )
    fx, fy, cx, cy, distortion = intrinsics
    if not (np.isfinite(camera.params).all() and fx > 0 and fy > 0 and camera.width > 0 and camera.height > 0):
        stated = ", ".join(f"{value:g}" for value in camera.params)
        raise InputError(f"{folder}: camera {number} has impossible intrinsics: {stated}")
    pinhole = PinholeCamera(fx, fy, cx, cy, camera.width, camera.height)
    return require_plausible(pinhole, distortion, f"{folder}: camera {number}")


def _observed(image: ModelImage, model: ColmapModel, frame: PosedImage, turn: Turn) -> SparsePoints:
    """Return the points that an image observes."""
    # A track may have two observations in one image. The first one is used.
    ids, first = np.unique(image.ids, return_index=True)
    xyz = model.positions(ids)
    kept = np.abs(xyz).max(axis=1, initial=0.0) <= FARTHEST
    raw = frame.undistorter.raw
    pixels = turn.pixels(image.pixels[first[kept]], *turn.size(raw.width, raw.height))
    pixels = frame.undistorter.points(pixels)
    return points_inside(xyz[kept], pixels, ids[kept], frame.undistorter, frame.T_camera_world)

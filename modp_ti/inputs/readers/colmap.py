"""Kind `colmap`: poses and points of a binary or text COLMAP model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from fields.frames.tracked_frame import SparsePoints
from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.files.trajectory import FARTHEST, checked_pose
from modp_ti.inputs.colmap_model import ColmapModel, ModelCamera, ModelImage, image_count, read_colmap_model
from modp_ti.inputs.point_cloud import spread_points
from modp_ti.inputs.posed_recording import PANORAMAS, PosedRecording, StoredView
from modp_ti.inputs.reader import GivenPosesSettings, RecordedSettings
from modp_ti.inputs.replay import PosedImage, points_inside
from modp_ti.inputs.sources import Distortion
from modp_ti.inputs.sources.distortion import colmap_intrinsics
from modp_ti.inputs.sources.orientation import Turn
from modp_ti.inputs.sources.undistortion import require_plausible

TOPS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")

# Most points that a frame gets of a model whose images observe none.
MOST_PROJECTED: int = GivenPosesSettings.model_fields["max_points"].default


class ColmapSettings(RecordedSettings):
    """A COLMAP model."""

    brings_cameras: ClassVar[bool] = True
    pose_files: ClassVar[Sequence[str]] = tuple(f"{top}/images.*" for top in TOPS)

    kind: Literal["colmap"] = "colmap"
    path: Path | None = Field(
        default=None,
        description="folder with cameras, images and points3D, or the parent of such a folder `0`; empty: `sparse/0` "
        "or `sparse`, next to the images' folder or in it",
    )

    def add_poses(self, recording: PosedRecording) -> None:
        """Give images their pose in the model, as `pose_by_model` does."""
        pose_by_model(recording, self.path)

    @classmethod
    def poses_of(cls, path: Path) -> Path | None:
        found = super().poses_of(path)
        return found and found.parent


def pose_by_model(recording: PosedRecording, given: Path | None, upright: bool = False) -> None:
    """Give images their pose in a model, in natural order, and the points that each observes.

    Where no image observes any, each gets the points of the model that project into it. Where the model has none, they
    are triangulated.

    Args:
        recording: The images.
        given: Folder of the model, or of models; None for the usual places.
        upright: Whether the model was made from the images turned as their EXIF orientation says. Otherwise the sizes
            of its cameras tell.

    Raises:
        InputError: If the model is missing or damaged, has an unsupported camera model, has no image in the folder, or
            if images do not match their cameras.
    """
    folder = _model_folder(recording, given)
    model = read_colmap_model(folder, posed_alone=True)
    if not model.images:
        raise InputError(f"{folder}: the COLMAP model holds no image")
    images, selected = recording.images, recording.selected
    if len(images.mounts) > 1:  # all faces of a panorama have a pose, or none
        stated = {image.name: image for image in model.images.values()}
        posed = {face: stated[face] for name in selected for face in images.views(name) if face in stated}
        recording.note_missing({name: None for name in selected if images.views(name)[0] in posed}, str(folder))
    else:
        entries = [(image.name, image) for image in model.images.values()]
        posed = recording.matched(entries, folder, str(folder), "images")
    cameras = {number: _camera(number, camera, folder) for number, camera in model.cameras.items()}
    views = {
        name: StoredView(*cameras[image.camera], checked_pose(image.T_camera_world, f"{folder}: image {image.name}"))
        for name, image in posed.items()
    }
    turns = dict(zip(views, recording.pose_stored(views, str(folder), upright), strict=True))

    near, count = np.abs(model.xyz).max(axis=1, initial=0.0) <= FARTHEST, len(model.ids)
    ids, xyz = model.ids[near], model.xyz[near]
    if len(ids) < count:
        recording.notes.append(f"{count - len(ids)} of {count} points of {folder} are NaN or infinite: left out")
    if count and recording.add_points(lambda frame: _observed(posed[frame.name], model, frame, turns[frame.name])):
        return
    if len(ids) and recording.add_points(lambda frame: spread_points(xyz, ids, frame, MOST_PROJECTED)):
        recording.notes.append(f"no image of {folder} observes a point: each gets those that project into it")
        return
    recording.notes.append(f"the images of {folder} see none of its {count} points: triangulated instead")
    recording.triangulate()


def _model_folder(recording: PosedRecording, given: Path | None) -> Path:
    """Return the folder with cameras, images and points3D.

    COLMAP writes a model to each of the folders 0, 1, ... where it cannot join all images. That of most images is used.
    """
    images = recording.source.require_path()
    roots = [given] if given is not None else [images.parent / "sparse", images / "sparse"]
    for root in roots:
        numbered = [root / "0", *sorted((f for f in root.glob("[0-9]*") if f.name != "0"), key=lambda f: f.name)]
        own = [root] if _is_model(root) else []
        parts = list(filter(_is_model, numbered))
        if own and (given is not None or not parts):
            return root
        if len(parts) > 1:
            counts = {folder: image_count(folder) for folder in parts}
            parts.sort(key=lambda folder: -counts[folder])
            said = ", ".join(f"{folder.name} with {count} images" for folder, count in counts.items())
            recording.notes.append(f"{root} holds several models, {said}: {parts[0].name} is used")
        if parts:
            return parts[0]
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

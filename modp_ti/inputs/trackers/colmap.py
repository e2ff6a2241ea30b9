"""Tracker `colmap`: poses and points of a binary or text COLMAP model, read with pycolmap."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints
from fields.geometry.camera import PinholeCamera
from modp_ti.config.settings import SourceSettings
from modp_ti.config.tracker_base_settings import GivenPosesSettings
from modp_ti.config.tracker_settings import ColmapSettings
from modp_ti.files.errors import InputError
from modp_ti.files.trajectory import FARTHEST, checked_pose
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import PosedImage, ReplayedTracker, points_inside
from modp_ti.inputs.sources import Distortion, ImageSource, Undistorter
from modp_ti.inputs.sources.distortion import colmap_intrinsics
from modp_ti.inputs.sources.intrinsics import require_plausible
from modp_ti.inputs.sources.orientation import AS_STORED, Turn
from modp_ti.inputs.sources.undistortion import undistorter_beside
from modp_ti.inputs.trackers.colmap_files import image_count, read_colmap_model
from modp_ti.inputs.trackers.given_poses import (
    PANORAMAS,
    checked_reader,
    matched_entries,
    missing_frames_note,
    selected_frames,
    sizes_note,
    solving,
    spread_points,
    triangulated_views,
)
from modp_ti.inputs.trackers.stored_cameras import turn_of_camera, turned_note

if TYPE_CHECKING:
    from modp_ti.files.quiet_pycolmap import pycolmap

__all__ = ["open_colmap"]

# Most points that a frame gets of a model whose images observe none.
MOST_PROJECTED: int = GivenPosesSettings.model_fields["max_points"].default


def open_colmap(
    source: SourceSettings, tracker: ColmapSettings, progress: Progress | None = None, upright: bool = False
) -> ReplayedTracker:
    """Open the images that have a pose in the model, in natural order, with the points that each observes.

    Where no image observes any, each gets the points of the model that project into it. Where the model has none, they
    are triangulated before the first frame is delivered. `tracker.path` is the model's folder.

    Args:
        source: Settings of the images.
        tracker: Settings of the tracker.
        progress: Called while points are triangulated.
        upright: Whether the model was made from the images turned as their EXIF orientation says. Otherwise the sizes
            of its cameras tell.

    Raises:
        InputError: If the model is missing or damaged, has an unsupported camera model, has no image in the folder, or
            if images do not match their cameras.
    """
    place = source.require_path()
    images = open_source(source)
    folder, others = _model_folder(place, tracker.path)
    model = read_colmap_model(folder, posed_alone=True)
    stated = [(image.name, image) for image in model.images.values() if image.has_pose]
    if not stated:
        raise InputError(f"{folder}: the COLMAP model holds no image{' with a pose' if model.images else ''}")
    if len(images.mounts) > 1:
        posed, notes = _posed_faces(images, source, dict(stated), folder)
    else:
        posed, notes = matched_entries(images, source, stated, folder, str(folder), "images")
    notes = [*others, *notes]
    stored = {i: _camera(camera, folder) for i, camera in model.cameras.items()}
    turns = dict.fromkeys(posed, AS_STORED)
    undistorters: dict[tuple[int, Turn], Undistorter] = {}
    cameras = {}
    for name, image in posed.items():
        camera, lens = stored[image.camera_id]
        if not upright:
            turns[name] = turn_of_camera(images, name, camera.width, camera.height, str(folder))
        key = image.camera_id, turns[name]
        if key not in undistorters:
            first = next(iter(undistorters.values()), None)
            undistorters[key] = undistorter_beside(first, *turns[name].camera(camera, lens), images.scale)
        cameras[name] = undistorters[key]
    notes += turned_note(turns.values(), str(folder))
    reader = checked_reader(images, source, cameras, str(folder))

    positions = {i: np.asarray(point.xyz, dtype=np.float64) for i, point in model.points3D.items()}
    farthest = np.abs(np.array(list(positions.values())).reshape(-1, 3)).max(axis=1)
    lost = {i for i, far in zip(positions, farthest.tolist(), strict=True) if not far <= FARTHEST}
    if lost:
        notes.append(f"{len(lost)} of {len(positions)} points of {folder} are NaN or infinite: left out")
    frames = []
    for name, image in posed.items():
        matrix = np.vstack([image.cam_from_world().matrix(), (0.0, 0.0, 0.0, 1.0)])
        T_camera_world = turns[name].T_turned_stored @ checked_pose(matrix, f"{folder}: image {image.name}")
        frames.append(PosedImage(name, cameras[name], T_camera_world))
        if positions or any((folder / f"points3D{suffix}").exists() for suffix in (".bin", ".txt")):
            points = _observed_points(image, positions, lost, cameras[name], turns[name], T_camera_world, folder)
            frames[-1] = frames[-1].with_points(points)
    if not any(len(frame.points) for frame in frames):
        ids = np.array([i for i in positions if i not in lost], dtype=np.int64)
        if len(ids):
            xyz = np.stack([positions[int(i)] for i in ids])
            frames = [frame.with_points(spread_points(xyz, ids, frame, MOST_PROJECTED)) for frame in frames]
            notes.append(f"no image of {folder} observes a point: each gets those that project into it")
        if not any(len(frame.points) for frame in frames):
            notes.append(f"the images of {folder} see none of its {len(positions)} points: triangulated instead")
            frames = triangulated_views(images, frames, solving(frames, source), progress)
    return ReplayedTracker(reader, frames, [*notes, *sizes_note(frames)])


def _posed_faces(
    images: ImageSource, source: SourceSettings, stated: dict[str, pycolmap.Image], folder: Path
) -> tuple[dict[str, pycolmap.Image], list[str]]:
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


def _camera(camera: pycolmap.Camera, folder: Path) -> tuple[PinholeCamera, Distortion]:
    model = camera.model.name
    intrinsics = colmap_intrinsics(model, camera.params.tolist())
    if model == "EQUIRECTANGULAR":
        raise InputError(f"{folder}: {PANORAMAS}")
    if intrinsics is None:
        raise InputError(f"{folder}: camera model {model} is not supported; run `colmap image_undistorter` first")
    fx, fy, cx, cy, distortion = intrinsics
    if not (np.isfinite(camera.params).all() and fx > 0 and fy > 0 and camera.width > 0 and camera.height > 0):
        raise InputError(f"{folder}: camera {camera.camera_id} has impossible intrinsics: {camera.params_to_string()}")
    pinhole = PinholeCamera(fx, fy, cx, cy, int(camera.width), int(camera.height))
    return require_plausible(pinhole, distortion, f"{folder}: camera {camera.camera_id}")


def _observed_points(
    image: pycolmap.Image,
    positions: dict[int, NDArray[np.float64]],
    lost: set[int],
    undistorter: Undistorter,
    turn: Turn,
    T_camera_world: NDArray[np.float64],
    folder: Path,
) -> SparsePoints:
    observed = [point for point in image.get_observation_points2D() if point.point3D_id not in lost]
    if not observed:
        return SparsePoints()
    if not all(point.point3D_id in positions for point in observed):
        raise InputError(f"{folder}: points3D is incomplete: image {image.name} observes points that it lacks")
    ids = np.array([point.point3D_id for point in observed], dtype=np.int64)
    # A track may have two observations in one image. The first one is used.
    ids, first = np.unique(ids, return_index=True)
    pixels = np.array([point.xy for point in observed])[first]
    pixels = undistorter.points(turn.pixels(pixels, *turn.size(undistorter.raw.width, undistorter.raw.height)))
    return points_inside(np.array([positions[int(i)] for i in ids]), pixels, ids, undistorter, T_camera_world)

"""Tracker `colmap`: poses and points of a binary or text COLMAP model, read with pycolmap."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints
from fields.geometry.camera import PinholeCamera
from modp_ti.config.settings import SourceSettings
from modp_ti.config.tracker_settings import ColmapSettings
from modp_ti.files.errors import InputError
from modp_ti.files.trajectory import checked_pose
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.replay import PosedImage, ReplayedTracker, points_inside
from modp_ti.inputs.sources import Distortion, Undistorter
from modp_ti.inputs.sources.distortion import colmap_intrinsics
from modp_ti.inputs.sources.intrinsics import require_plausible
from modp_ti.inputs.sources.orientation import AS_STORED, Turn
from modp_ti.inputs.sources.undistortion import undistorter_beside
from modp_ti.inputs.trackers.colmap_files import read_colmap_model
from modp_ti.inputs.trackers.given_poses import checked_reader, matched_entries, sizes_note
from modp_ti.inputs.trackers.stored_cameras import turn_of_camera, turned_note

if TYPE_CHECKING:
    from modp_ti.files.quiet_pycolmap import pycolmap

__all__ = ["open_colmap"]


def open_colmap(source: SourceSettings, tracker: ColmapSettings, upright: bool = False) -> ReplayedTracker:
    """Open the images that have a pose in the model, in natural order, with the points that each observes.

    `tracker.path` is the model's folder.

    Args:
        source: Settings of the images.
        tracker: Settings of the tracker.
        upright: Whether the model was made from the images turned as their EXIF orientation says. Otherwise the sizes
            of its cameras tell.

    Raises:
        InputError: If the model is missing or damaged, has an unsupported camera model, has no image in the folder, or
            if images do not match their cameras.
    """
    place = source.require_path()
    images = open_source(source)
    folder = _model_folder(place, tracker.path)
    model = read_colmap_model(folder)
    stated = [(image.name, image) for image in model.images.values() if image.has_pose]
    if not stated:
        raise InputError(f"{folder}: the COLMAP model holds no image{' with a pose' if model.images else ''}")
    posed, notes = matched_entries(images, source, stated, folder, str(folder), "images")
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
    frames = []
    for name, image in posed.items():
        matrix = np.vstack([image.cam_from_world().matrix(), (0.0, 0.0, 0.0, 1.0)])
        T_camera_world = turns[name].T_turned_stored @ checked_pose(matrix, f"{folder}: image {image.name}")
        points = _observed_points(image, positions, cameras[name], turns[name], T_camera_world, folder)
        frames.append(PosedImage(name, cameras[name], T_camera_world, points))
    return ReplayedTracker(reader, frames, [*notes, *sizes_note(frames)])


def _model_folder(images: Path, given: Path | None) -> Path:
    """Return the folder with cameras, images and points3D."""
    roots = [given] if given is not None else [images.parent / "sparse", images / "sparse"]
    for root in roots:
        for folder in (root, root / "0") if given is not None else (root / "0", root):
            if any((folder / f"cameras{suffix}").exists() for suffix in (".bin", ".txt")):
                return folder
    if given is None:
        raise InputError(f"no COLMAP model in {images.parent / 'sparse'} or its folder 0: set tracker.path")
    if not given.exists():
        raise InputError(f"{given}: no such folder (tracker.path); it should hold a COLMAP model")
    raise InputError(f"{given}: holds no COLMAP model (cameras, images and points3D as .bin or .txt)")


def _camera(camera: pycolmap.Camera, folder: Path) -> tuple[PinholeCamera, Distortion]:
    model = camera.model.name
    intrinsics = colmap_intrinsics(model, camera.params.tolist())
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
    undistorter: Undistorter,
    turn: Turn,
    T_camera_world: NDArray[np.float64],
    folder: Path,
) -> SparsePoints:
    observed = image.get_observation_points2D()
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

"""Kind `transforms`: a transforms.json of instant-ngp or nerfstudio."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from modp_ti.files.errors import InputError
from modp_ti.files.trajectory import checked_pose
from modp_ti.inputs.capture import OPENCV_OPENGL
from modp_ti.inputs.given_poses import (
    PANORAMAS,
    checked_reader,
    found_file,
    matched_entries,
    read_entries,
    solving,
    triangulated_views,
    views_at,
)
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.point_cloud import read_ply_points, visible_points
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.reader import RecordedSettings
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.inputs.sources import Distortion, ImageSource
from modp_ti.inputs.sources.distortion import COEFFICIENTS, colmap_lens
from modp_ti.inputs.sources.intrinsics import require_plausible
from modp_ti.inputs.sources.listed_images import ListedImages
from modp_ti.inputs.sources.masks import MaskFolder
from modp_ti.inputs.sources.protocol import require_intrinsics
from modp_ti.inputs.stored_cameras import StoredView, stored_frames

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig, SourceSettings

NAME = "transforms.json"

PERSPECTIVE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
FISHEYE_MODELS = ("OPENCV_FISHEYE",)


class TransformsSettings(RecordedSettings):
    """A transforms.json of instant-ngp or nerfstudio."""

    brings_cameras: ClassVar[bool] = True
    places_panoramas: ClassVar[bool] = True
    pose_files: ClassVar[Sequence[str]] = (NAME, "transforms_train.json")

    kind: Literal["transforms"] = Field(
        default="transforms", description="a transforms.json of instant-ngp or nerfstudio"
    )
    path: Path | None = Field(
        default=None, description="the file or its folder; empty: `transforms.json` next to the images' folder or in it"
    )

    def open(self, scene: SceneConfig, progress: Progress | None = None) -> ReplayedTracker:
        """Open the frames of the file whose images are in the folder, in natural order of the image names.

        Points are read from `ply_file_path` if the file names one that exists. Otherwise they are triangulated with the
        given poses before the first frame is delivered.
        """
        source = scene.source
        images = open_source(source)
        file = _file(source, self)
        data, stated = read_entries(file, "frames", "file_path", f"a {NAME}")
        masks = masks_of_transforms(images, source, self)
        entries, notes = matched_entries(images, source, stated, file, file.name, "frames")
        if images.whole is images:
            views = {
                name: StoredView(*_intrinsics({**data, **entry}, images, name, file), _pose(entry, file))
                for name, entry in entries.items()
            }
            frames, _, more = stored_frames(images, views, str(file))
            notes += more
        else:  # the source knows the camera of a panorama's faces
            face = require_intrinsics(images).undistorter(images.scale)
            poses = {name: _pose(entry, file) for name, entry in entries.items()}
            frames = [view for name, T in poses.items() for view in views_at(images, name, face, T)]
        reader = checked_reader(images, source, {frame.name: frame.undistorter for frame in frames}, str(file), masks)

        cloud = data.get("ply_file_path")
        cloud = cloud.replace("\\", "/") if isinstance(cloud, str) else None  # as Windows writes it
        if cloud is not None and os.path.isfile(file.parent / cloud):
            xyz = read_ply_points(file.parent / cloud)
            frames = [f.with_points(visible_points(xyz, f.undistorter, f.T_camera_world)) for f in frames]
        else:
            if cloud is not None:
                notes.append(f"{file.name} names points that are not there ({cloud}): triangulated instead")
            frames = triangulated_views(images, frames, solving(frames, source), progress)
        return ReplayedTracker(reader, frames, notes)


def masks_of_transforms(images: ImageSource, source: SourceSettings, tracker: TransformsSettings) -> MaskFolder | None:
    """Return the masks that the file names with `mask_path`, relative to itself; None if it names none.

    Masks and depth maps that lie among the images are taken out of these.

    Raises:
        InputError: If the file is missing or malformed.
    """
    file, masks, others = _file(source, tracker), {}, set()
    for stated, entry in read_entries(file, "frames", "file_path", f"a {NAME}")[1]:
        for key in ("mask_path", "depth_file_path"):
            if isinstance(entry.get(key), str):
                path = entry[key].replace("\\", "/")
                others.add((file.parent / path).resolve())
                name = images.whole.find(stated) if key == "mask_path" else None
                if name is not None:
                    masks[name] = path
    if isinstance(images, ListedImages):
        folder = images.path.resolve()
        images.leave_out({name for name in images.names if folder / name in others})
    if masks and images.whole is not images:
        images.whole.add_note(f"{file.name}: `mask_path` is not used with source.panorama")
        return None
    return MaskFolder(file.parent, masks, f"mask_path of {file}") if masks else None


def _file(source: SourceSettings, tracker: TransformsSettings) -> Path:
    place = source.require_path()
    return found_file(tracker.path, [place.parent / NAME, place / NAME], f"a {NAME}")


def _pose(entry: Mapping[str, Any], file: Path) -> NDArray[np.float64]:
    """Read T_camera_world (4, 4) with OpenCV axes."""
    what = f"{file}: frame {entry['file_path']}"
    try:
        matrix = np.array(entry.get("transform_matrix"), dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        raise InputError(f"{what}: `transform_matrix` must be 4 rows of 4 numbers") from None
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4):
        raise InputError(f"{what}: `transform_matrix` must be 4 rows of 4 numbers, camera to world")
    return inverse_se3(checked_pose(matrix, what) @ OPENCV_OPENGL)


def _intrinsics(
    values: Mapping[str, Any], images: ImageSource, name: str, file: Path
) -> tuple[PinholeCamera, Distortion]:
    """Read the camera of the stored image. `values` are the file's keys, overridden by those of the frame."""

    def number(key: str) -> float | None:
        value = values.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            shown = json.dumps(value)[:60]
            raise InputError(f"{file}: `{key}` must be a number, not {shown} (frame {values['file_path']})")
        return float(value)

    width, height = number("w"), number("h")
    if width is None or height is None:
        stored = images.turn(name).size(*images.size(name))
        width, height = float(width or stored[0]), float(height or stored[1])
    if width < 1 or height < 1 or width != int(width) or height != int(height):
        raise InputError(f"{file}: `w` and `h` must be whole numbers of pixels, not {width:g} and {height:g}")

    def focal(key: str, angle_key: str, size: float) -> float | None:
        given, angle = number(key), number(angle_key)
        if given is None and angle is not None and 0 < angle < math.pi:
            given = 0.5 * size / math.tan(0.5 * angle)
        return given

    fx, fy = focal("fl_x", "camera_angle_x", width), focal("fl_y", "camera_angle_y", height)
    fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
    if fx is None or fy is None or fx <= 0 or fy <= 0:
        raise InputError(f"{file}: no focal length for {values['file_path']}: give `fl_x` or `camera_angle_x`")
    cx, cy = number("cx"), number("cy")
    camera = PinholeCamera(
        fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy, int(width), int(height)
    )

    what = f"{file}: frame {values['file_path']}"
    k1, k2, k3, k4, p1, p2 = (number(key) or 0.0 for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = str(values.get("camera_model", "OPENCV")).upper()
    if values.get("is_fisheye") is True:
        model = "OPENCV_FISHEYE"
    if model in FISHEYE_MODELS:
        return require_plausible(camera, Distortion((k1, k2, k3, k4), fisheye=True), what)
    if model in COEFFICIENTS:
        lens = colmap_lens(model, [number(key) or 0.0 for key in COEFFICIENTS[model]])
        assert lens is not None, "COEFFICIENTS names supported models"
        return require_plausible(camera, lens, what)
    if model == "EQUIRECTANGULAR":
        raise InputError(f"{file}: {PANORAMAS}")
    if model not in PERSPECTIVE_MODELS:
        supported = ", ".join((*PERSPECTIVE_MODELS, *FISHEYE_MODELS, *COEFFICIENTS))
        raise InputError(f"{file}: camera model {model} is not supported ({supported}); undistort the images first")
    return require_plausible(camera, Distortion((k1, k2, k3, k4), tangential=(p1, p2)), what)

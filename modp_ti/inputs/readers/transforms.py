"""Kind `transforms`: a transforms.json of instant-ngp or nerfstudio."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.inputs.capture import checked_numbers, opengl_pose
from modp_ti.inputs.point_cloud import read_ply_points, visible_points
from modp_ti.inputs.posed_recording import PANORAMAS, PosedRecording, StoredView, read_entries
from modp_ti.inputs.reader import RecordedSettings
from modp_ti.inputs.sources import Distortion, ImageSource
from modp_ti.inputs.sources.distortion import COEFFICIENTS, colmap_lens
from modp_ti.inputs.sources.frame_reader import MaskFolder
from modp_ti.inputs.sources.image_folder import ListedImages
from modp_ti.inputs.sources.undistortion import require_plausible

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import SourceSettings

NAME, WHAT = "transforms.json", "a transforms.json"
PERSPECTIVE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
FISHEYE = "OPENCV_FISHEYE"


class TransformsSettings(RecordedSettings):
    """A transforms.json of instant-ngp or nerfstudio."""

    brings_cameras: ClassVar[bool] = True
    places_panoramas: ClassVar[bool] = True
    pose_files: ClassVar[Sequence[str]] = (NAME, "transforms_train.json")

    kind: Literal["transforms"] = "transforms"
    path: Path | None = Field(
        default=None, description="the file or its folder; empty: `transforms.json` next to the images' folder or in it"
    )

    def add_poses(self, recording: PosedRecording) -> None:
        """Give images the pose and camera of their frame in the file, in natural order of the image names.

        Points are read from `ply_file_path` if the file names one that exists. Otherwise they are triangulated.
        """
        file, images = self.found(recording.source, (NAME,), WHAT), recording.images
        data, stated = read_entries(file, "frames", "file_path", WHAT)
        recording.masks = masks_of_transforms(images, recording.source, self)
        entries = recording.matched(stated, file, file.name, "frames")
        poses = {
            name: opengl_pose(entry.get("transform_matrix"), f"{file}: frame {entry['file_path']}")
            for name, entry in entries.items()
        }
        if images.whole is images:
            views = {}
            for name, entry in entries.items():
                size = lambda name=name: images.turn(name).size(*images.size(name))  # noqa: E731  # of the stored image
                views[name] = StoredView(*_camera({**data, **entry}, size, file), poses[name])
            recording.pose_stored(views, str(file))
        else:  # the source knows the camera of a panorama's faces
            recording.pose(poses)

        cloud = data.get("ply_file_path")
        if isinstance(cloud, str) and os.path.isfile(place := file.parent / cloud.replace("\\", "/")):
            xyz = read_ply_points(place)
            recording.add_points(lambda frame: visible_points(xyz, frame.undistorter, frame.T_camera_world))
            return
        if isinstance(cloud, str):
            recording.notes.append(f"{file.name} names points that are not there ({cloud}): triangulated instead")
        recording.triangulate()


def masks_of_transforms(images: ImageSource, source: SourceSettings, tracker: TransformsSettings) -> MaskFolder | None:
    """Return the masks that the file names with `mask_path`, relative to itself; None if it names none.

    Masks and depth maps that lie among the images are taken out of these.

    Raises:
        InputError: If the file is missing or malformed.
    """
    file, masks, others = tracker.found(source, (NAME,), WHAT), {}, set()
    for image, entry in read_entries(file, "frames", "file_path", WHAT)[1]:
        for key in ("mask_path", "depth_file_path"):
            if isinstance(entry.get(key), str):
                path = entry[key].replace("\\", "/")
                others.add((file.parent / path).resolve())
                name = images.whole.find(image) if key == "mask_path" else None
                if name is not None:
                    masks[name] = path
    if isinstance(images, ListedImages):
        folder = images.path.resolve()
        images.leave_out({name for name in images.names if folder / name in others})
    if masks and images.whole is not images:
        images.whole.add_note(f"{file.name}: `mask_path` is not used with source.panorama")
        return None
    return MaskFolder(file.parent, masks, f"mask_path of {file}") if masks else None


def _camera(
    values: Mapping[str, Any], stored_size: Callable[[], tuple[int, int]], file: Path
) -> tuple[PinholeCamera, Distortion]:
    """Read the camera of a stored image. `values` are the file's keys, overridden by those of the frame."""
    what = f"{file}: frame {values['file_path']}"

    def number(key: str) -> float | None:
        value = values.get(key)
        return None if value is None else checked_numbers(value, 1, f"{what}: `{key}`")[0]

    width, height = number("w"), number("h")
    if width is None or height is None:
        stored = stored_size()
        width, height = float(width or stored[0]), float(height or stored[1])
    if width < 1 or height < 1 or width != int(width) or height != int(height):
        raise InputError(f"{what}: `w` and `h` must be whole numbers of pixels, not {width:g} and {height:g}")

    def focal(key: str, angle_key: str, size: float) -> float | None:
        given, angle = number(key), number(angle_key)
        if given is None and angle is not None and 0 < angle < math.pi:
            given = 0.5 * size / math.tan(0.5 * angle)
        return given

    fx, fy = focal("fl_x", "camera_angle_x", width), focal("fl_y", "camera_angle_y", height)
    fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
    if fx is None or fy is None or fx <= 0 or fy <= 0:
        raise InputError(f"{what}: has no focal length: give `fl_x` or `camera_angle_x`")
    cx, cy = number("cx"), number("cy")
    cx, cy = (width / 2 if cx is None else cx), (height / 2 if cy is None else cy)
    camera = PinholeCamera(fx, fy, cx, cy, int(width), int(height))

    k1, k2, k3, k4, p1, p2 = (number(key) or 0.0 for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = FISHEYE if values.get("is_fisheye") is True else str(values.get("camera_model", "OPENCV")).upper()
    if model == "EQUIRECTANGULAR":
        raise InputError(f"{file}: {PANORAMAS}")
    if model == FISHEYE:
        lens = Distortion((k1, k2, k3, k4), fisheye=True)
    elif model in PERSPECTIVE_MODELS:
        lens = Distortion((k1, k2, k3, k4), tangential=(p1, p2))
    elif model in COEFFICIENTS:
        lens = colmap_lens(model, [number(key) or 0.0 for key in COEFFICIENTS[model]])
        assert lens is not None, "COEFFICIENTS names supported models"
    else:
        supported = ", ".join((*PERSPECTIVE_MODELS, FISHEYE, *COEFFICIENTS))
        raise InputError(f"{file}: camera model {model} is not supported ({supported}); undistort the images first")
    return require_plausible(camera, lens, what)

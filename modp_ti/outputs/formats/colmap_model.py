"""A run as a COLMAP model: its cameras, the refined poses of all frames and the tracked points with what saw them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.files.atomic import write_picture
from modp_ti.inputs.tracked_points import TrackedPoints

__all__ = ["image_names", "write_colmap", "write_image"]


def image_names(names: Sequence[str], written: bool) -> list[str]:
    """What the model calls the frames of these names: the same, or as PNG files where their images are `written`."""
    if not written:
        return list(names)
    renamed = [str(PurePosixPath(name).with_suffix(".png")) for name in names]
    if len(set(renamed)) == len(renamed):
        return renamed
    return [f"{name}.png" for name in names]


def write_colmap(
    folder: Path,
    names: Sequence[str],
    cameras: Sequence[PinholeCamera],
    poses: Sequence[NDArray[np.float64]],
    points: TrackedPoints,
) -> None:
    """Write `cameras`, `images` and `points3D` (.bin) of frames with their T_camera_world (4, 4) into a new folder.

    Cameras are those of the mapped images, PINHOLE. Images are numbered from 1 in their order, points from 1 in the
    order in which frames saw them first. Points are where the tracker has them; their errors are those under the given
    poses.
    """
    from modp_ti.files.quiet_pycolmap import pycolmap

    model = pycolmap.Reconstruction()
    camera_ids: dict[PinholeCamera, int] = {}
    for camera in cameras:
        if camera not in camera_ids:
            camera_ids[camera] = len(camera_ids) + 1
            params = [camera.fx, camera.fy, camera.cx, camera.cy]
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(
                    camera_id=camera_ids[camera],
                    model="PINHOLE",
                    width=camera.width,
                    height=camera.height,
                    params=params,
                )
            )
    tracks = [pycolmap.Track() for _ in range(len(points))]
    rows = zip(names, cameras, poses, points.rows, points.pixels, strict=True)
    for number, (name, camera, T_camera_world, seen, pixels) in enumerate(rows, start=1):
        image = pycolmap.Image(
            name=name, keypoints=pixels.astype(np.float64), camera_id=camera_ids[camera], image_id=number
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(T_camera_world[:3]))
        for place, row in enumerate(seen.tolist()):
            tracks[row].add_element(number, place)
    for xyz, track, colour in zip(points.xyz, tracks, points.colours, strict=True):
        model.add_point3D(xyz, track, colour)
    model.update_point_3d_errors()
    folder.mkdir(parents=True)
    model.write_binary(str(folder))


def write_image(folder: Path, name: str, frame: TrackedFrame) -> None:
    """Write the frame's undistorted image as `images/name` (PNG), and its mask, where it has one, as `masks/name.png`.

    Masks are COLMAP's: black where a pixel is ignored.
    """
    target = folder / "images" / name
    target.parent.mkdir(parents=True, exist_ok=True)
    write_picture(target, np.round(frame.image * 255.0).astype(np.uint8))
    if frame.mask is not None:
        target = folder / "masks" / f"{name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        write_picture(target, frame.mask.astype(np.uint8) * 255)

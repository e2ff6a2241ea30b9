"""Writes a run as a COLMAP model: cameras, refined poses of all frames, and tracked points with their observations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import NO_ORIGIN
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.files.atomic import write_picture
from modp_ti.inputs.sources import Picture
from modp_ti.inputs.tracked_points import TrackedPoints

__all__ = ["image_names", "write_colmap", "write_image"]


def image_names(names: Sequence[str], written: bool) -> list[str]:
    """Return the image names of the model.

    Args:
        names: Names of the frames.
        written: Whether the images are written as well. The names then end in `.png`.
    """
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
    origin: NDArray[np.float64] = NO_ORIGIN,
) -> None:
    """Write a COLMAP model (`cameras.bin`, `images.bin`, `points3D.bin`) to a new folder.

    Images are numbered from 1 in their order, and points from 1 in the order of their first observation. Point
    positions are those of the tracker. The stored errors are reprojection errors under `poses`.

    Args:
        folder: The folder to create.
        names: Names of the images.
        cameras: PINHOLE camera of each undistorted image.
        poses: T_camera_world (4, 4) of each image.
        points: Tracked points with the pixels of each frame.
        origin: Where the origin of `points` lies in the world of the poses (3,).
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
    for xyz, track, colour in zip(points.xyz + origin, tracks, points.colours, strict=True):
        model.add_point3D(xyz, track, colour)
    model.update_point_3d_errors()
    folder.mkdir(parents=True)
    model.write_binary(str(folder))


def write_image(folder: Path, name: str, frame: TrackedFrame | Picture) -> None:
    """Write the undistorted image of a frame as `images/NAME` (PNG), and its mask, if any, as `masks/NAME.png`.

    Masks follow COLMAP's convention: ignored pixels are black.
    """
    target = folder / "images" / name
    target.parent.mkdir(parents=True, exist_ok=True)
    write_picture(target, np.round(frame.image * 255.0).astype(np.uint8))
    if frame.mask is not None:
        target = folder / "masks" / f"{name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        write_picture(target, frame.mask.astype(np.uint8) * 255)

"""Writes a run as a data set for other programs: images, and their poses as a COLMAP model or a transforms.json."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import NO_ORIGIN
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from modp_ti.files.atomic import write_picture, written_aside
from modp_ti.files.errors import InputError
from modp_ti.inputs.delivered_frames import TrackedPoints
from modp_ti.inputs.sources import Picture

# Converts OpenCV camera axes to OpenGL camera axes.
OPENGL_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


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


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes `folder` on exit.

    Raises:
        InputError: If `folder` exists and is not empty.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: is there already; name a new folder (--output), or remove it")
    with written_aside(folder) as partial:
        partial.mkdir()
        yield partial
        if folder.is_dir():
            folder.rmdir()


def rename_images(model: Path, target: Path, names: Sequence[str]) -> None:
    """Copy a COLMAP model with new image names.

    Args:
        model: Folder of the model.
        target: Folder to create.
        names: New names of the images, in their order.
    """
    from modp_ti.files.quiet_pycolmap import pycolmap

    reconstruction = pycolmap.Reconstruction(str(model))
    for number, name in zip(sorted(reconstruction.images), names, strict=True):
        reconstruction.images[number].name = name
    target.mkdir(parents=True)
    reconstruction.write_binary(str(target))


def write_transforms(
    folder: Path,
    names: Sequence[str],
    cameras: Sequence[PinholeCamera],
    poses: Sequence[NDArray[np.float64]],
    held_out: Sequence[int],
    points: str,
) -> None:
    """Write nerfstudio's `transforms.json` for the images in `images/` and the masks in `masks/`.

    Its matrices are camera to world with OpenGL camera axes (x right, y up, z back). The world frame is that of
    `poses`.

    Args:
        folder: The data set's folder.
        names: Names of the images.
        cameras: Camera of each image.
        poses: T_camera_world (4, 4) of each image.
        held_out: Positions of the images for testing.
        points: Name of a PLY file with initial points.
    """
    one = len(set(cameras)) == 1
    data: dict[str, object] = {"camera_model": "OPENCV", **(_intrinsics(cameras[0]) if one else {})}
    files = [f"images/{name}" for name in names]
    frames = []
    for name, file, camera, T in zip(names, files, cameras, poses, strict=True):
        frame: dict[str, object] = {"file_path": file, **({} if one else _intrinsics(camera))}
        if (folder / "masks" / f"{name}.png").is_file():
            frame["mask_path"] = f"masks/{name}.png"
        frame["transform_matrix"] = (inverse_se3(T) @ OPENGL_OPENCV).tolist()
        frames.append(frame)
    data["ply_file_path"] = points
    if held_out:
        tested = {files[index] for index in held_out}
        data["train_filenames"] = [file for file in files if file not in tested]
        # Validation and test share the held-out frames. nerfstudio uses `val` during training and `test` for
        # evaluation, and requires all splits if one is listed.
        data["val_filenames"] = data["test_filenames"] = [file for file in files if file in tested]
    data["frames"] = frames
    (folder / "transforms.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def _intrinsics(camera: PinholeCamera) -> dict[str, float]:
    return {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
    }

"""Writes a finished run as a data set for training elsewhere: images with a COLMAP model or a transforms.json."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from modp_ti.files.atomic import written_aside
from modp_ti.files.errors import InputError

__all__ = ["new_folder", "rename_images", "write_transforms"]

# Converts OpenCV camera axes to OpenGL camera axes.
OPENGL_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


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

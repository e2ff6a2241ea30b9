"""A finished run as a data set to train on elsewhere: images with a COLMAP model, or with a transforms.json."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from modp_ti.files.errors import InputError

__all__ = ["dataset_folder", "rename_images", "write_transforms"]

# From OpenCV's axes of a camera to OpenGL's.
OPENGL_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@contextmanager
def dataset_folder(folder: Path) -> Iterator[Path]:
    """A folder to write into, which becomes `folder` at the end. Raises InputError where that holds something."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: is there already; name a new folder (--output), or remove it")
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir()
        yield partial
        if folder.is_dir():
            folder.rmdir()
        os.replace(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def rename_images(model: Path, target: Path, names: Sequence[str]) -> None:
    """Write the COLMAP model of a run into the new folder `target`, its images called `names`, in their order."""
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
    """Write `transforms.json` beside `images/` (and `masks/`) of frames with T_camera_world (4, 4).

    Its matrices are camera to world with OpenGL's axes of the camera (x right, y up, z back); the world is that of the
    poses. held_out: positions of the frames that nerfstudio is to test on. points: name of a PLY file to begin with.
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
        # The same frames twice: nerfstudio looks at `val` while it trains and at `test` when it evaluates, and where
        # one split is listed it refuses a set without the others.
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
        "k1": 0.0,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
    }

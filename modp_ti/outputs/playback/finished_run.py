"""`FinishedRun`: reads the output folder of a run for the commands that follow it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import shifted_poses
from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.files.reading import reading
from modp_ti.files.run_folder import require_whole
from modp_ti.inputs.colmap_model import read_colmap_model
from modp_ti.inputs.sources import NO_DISTORTION
from modp_ti.inputs.sources.intrinsics import require_plausible
from modp_ti.outputs.formats.run_files import FramesRecord, read_frames
from modp_ti.outputs.formats.splats_ply import read_splats
from modp_ti.outputs.formats.trajectory import read_trajectory

NEEDED = ("config.yaml", "splats.ply", "trajectory.txt", "colmap", "frames.json")


@dataclass(frozen=True)
class FinishedRun:
    """A map and its frames.

    Attributes:
        folder: The run's output folder.
        names: Image names in the COLMAP model.
        timestamps: (N,) time stamps [s].
        poses: (N, 4, 4) refined T_camera_world, in coordinates from `record.origin`, as the Gaussians are.
        cameras: Camera of each frame.
        record: Near plane, scene depth, keyframes, held-out frames and origin.
    """

    folder: Path
    names: list[str]
    timestamps: NDArray[np.float64]
    poses: NDArray[np.float64]
    cameras: list[PinholeCamera]
    record: FramesRecord

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def gaussians(self) -> dict[str, NDArray[np.float32]]:
        """Gaussians as `GaussianField.load` takes them.

        Raises:
            InputError: If the file is damaged or the map is empty.
        """
        state = read_splats(self.folder / "splats.ply")
        if len(state["position"]) == 0:
            raise InputError(f"{self.folder / 'splats.ply'}: the map holds no Gaussian")
        return state

    @cached_property
    def way(self) -> NDArray[np.int64]:
        """Positions (M,) of the frames along the camera's way: all, but of the frames of one time only the first."""
        return np.flatnonzero(np.diff(self.timestamps, prepend=np.nan) != 0)

    @property
    def size(self) -> tuple[int, int]:
        """Largest width and height of the images [px]."""
        return max(camera.width for camera in self.cameras), max(camera.height for camera in self.cameras)

    @property
    def mapped(self) -> list[int]:
        """Positions of the frames that were not held out."""
        held_out = set(self.record.held_out)
        return [index for index in range(len(self)) if index not in held_out]

    def spread(self, most: int) -> list[int]:
        """Return the positions of at most `most` evenly spaced frames that were not held out."""
        mapped = self.mapped
        count = min(len(mapped), most)
        return [mapped[i * len(mapped) // count] for i in range(count)]


def open_run(folder: Path) -> FinishedRun:
    """Read the output folder of a finished run.

    Raises:
        InputError: If the folder holds no finished run, or a damaged one.
    """
    folder = folder.expanduser()
    if not folder.is_dir():
        what = "not a folder" if folder.exists() else "no such folder; a run makes it at its end"
        raise InputError(f"{folder}: {what}: name the output folder of a finished run")
    require_whole(folder)
    missing = [name for name in NEEDED if not (folder / name).exists()]
    if len(missing) == len(NEEDED):
        raise InputError(f"{folder}: no run has left anything here: name the output folder of a finished run")
    if missing == ["frames.json"]:
        raise InputError(
            f"{folder}: an earlier version made it, without frames.json: run it again, "
            f"modp-ti run {folder / 'config.yaml'}"
        )
    if missing:
        raise InputError(f"{folder}: not the output of a finished run, {missing[0]} is missing")
    with reading(folder):
        timestamps, poses = read_trajectory(folder / "trajectory.txt")
        names, cameras = _read_model(folder / "colmap")
        if len(names) != len(poses) or not names:
            raise InputError(f"{folder}: trajectory.txt has {len(poses)} frames, colmap/ {len(names)}: not of one run")
        record = read_frames(folder / "frames.json", len(poses))
        return FinishedRun(folder, names, timestamps, shifted_poses(poses, -record.origin), cameras, record)


def _read_model(folder: Path) -> tuple[list[str], list[PinholeCamera]]:
    """Return the names and cameras of the images, in order."""
    model = read_colmap_model(folder)
    images = [model.images[number] for number in sorted(model.images)]
    of_id = {}
    for number, camera in model.cameras.items():
        what = f"{folder}: camera {number}"
        try:
            fx, fy, cx, cy = map(float, camera.params)
            pinhole = PinholeCamera(fx, fy, cx, cy, camera.width, camera.height)
        except (ValueError, TypeError) as error:
            raise InputError(f"{what} is none of a run: {error}") from None
        of_id[number], _ = require_plausible(pinhole, NO_DISTORTION, what)
    for image in images:
        # The names are used as paths for reading and for exports, so they must stay inside the image folder.
        parts = PurePosixPath(image.name).parts
        if not parts or parts[0] == "/" or ".." in parts or "\0" in image.name:
            raise InputError(f"{folder}: image {image.name!r} is no name below the folder of images")
    return [image.name for image in images], [of_id[image.camera] for image in images]

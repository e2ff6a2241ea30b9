"""`FinishedRun`: reads the output folder of a run, or a file of splats, for the commands that follow it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import shifted_poses
from fields.geometry.camera import PinholeCamera
from modp_ti.config.keys import differing_keys
from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.files import read_json
from modp_ti.files.errors import InputError
from modp_ti.files.reading import reading
from modp_ti.files.run_folder import require_whole
from modp_ti.inputs.colmap_model import ModelCamera, read_colmap_model
from modp_ti.inputs.sources import NO_DISTORTION
from modp_ti.inputs.sources.undistortion import require_plausible
from modp_ti.outputs.formats.run_files import FramesRecord, read_frames
from modp_ti.outputs.formats.splats_ply import read_splats
from modp_ti.outputs.formats.trajectory import read_trajectory
from modp_ti.outputs.playback.camera_paths import looking_at

METRICS, SETTINGS = "metrics.json", "config.yaml"
# Settings on which neither the map nor the other output files depend, but for the device, in the last digits.
FREE = ("output", "device", "threads", "snapshot_every", "snapshot_store", "source.prefetch", "view")
NEEDED = ("config.yaml", "splats.ply", "trajectory.txt", "colmap", "frames.json")

# Of a file of splats: the quantile of the distances from the centre that counts as the map's radius, and from where the
# camera looks at the centre, in radii: above and in front of it, with y down and z ahead.
RADIUS = 0.8
PLACE = np.array([0.0, -0.5, -1.8])
NEAR = 0.01
CAMERA = PinholeCamera(640.0, 640.0, 480.0, 360.0, 960, 720)


@dataclass(frozen=True)
class FinishedRun:
    """A map and its frames.

    Attributes:
        folder: The run's output folder, or the file of splats.
        names: Image names in the COLMAP model.
        timestamps: (N,) time stamps [s].
        poses: (N, 4, 4) refined T_camera_world, in coordinates from `record.origin`, as the Gaussians are.
        cameras: Camera of each frame.
        record: Near plane, scene depth, keyframes, held-out frames and origin.
        splats: The Gaussians, where they have been read already.
    """

    folder: Path
    names: list[str]
    timestamps: NDArray[np.float64]
    poses: NDArray[np.float64]
    cameras: list[PinholeCamera]
    record: FramesRecord
    splats: dict[str, NDArray[np.float32]] | None = None

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def gaussians(self) -> dict[str, NDArray[np.float32]]:
        """Gaussians as `GaussianField.load` takes them.

        Raises:
            InputError: If the file is damaged or the map is empty.
        """
        return self.splats if self.splats is not None else _some_splats(self.folder / "splats.ply")

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
    if missing := [name for name in NEEDED if not (folder / name).exists()]:
        raise InputError(f"{folder}: not the output folder of a finished run: {', '.join(missing)} is missing")
    with reading(folder):
        timestamps, poses = read_trajectory(folder / "trajectory.txt")
        model = read_colmap_model(folder / "colmap")
        images = [model.images[number] for number in sorted(model.images)]
        if len(images) != len(poses) or not images:
            raise InputError(f"{folder}: trajectory.txt has {len(poses)} frames, colmap/ {len(images)}: not of one run")
        for image in images:  # their names are paths below the folder of images
            if not image.name or not {"..", "/"}.isdisjoint(PurePosixPath(image.name).parts):
                raise InputError(f"{folder}: image {image.name!r} is no name below the folder of images")
        cameras = {number: _pinhole(camera, f"{folder}: camera {number}") for number, camera in model.cameras.items()}
        record = read_frames(folder / "frames.json", len(poses))
        return FinishedRun(
            folder,
            [image.name for image in images],
            timestamps,
            shifted_poses(poses, -record.origin),
            [cameras[image.camera] for image in images],
            record,
        )


def open_splats(path: Path) -> FinishedRun:
    """Read a PLY file of splats as a run of one frame, from which the whole is seen.

    Raises:
        InputError: If the file is no PLY file of 3DGS, cannot be read, or holds no splat.
    """
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path}: splats are read from .ply; splat-transform converts other formats")
    state = _some_splats(path)
    centre = np.median(state["position"], axis=0).astype(np.float64)
    radius = max(float(np.quantile(np.linalg.norm(state["position"] - centre, axis=1), RADIUS)), 1e-9)
    T = looking_at(centre + radius * PLACE, centre, np.array([0.0, -1.0, 0.0]))
    depth = radius * float(np.linalg.norm(PLACE))
    record = FramesRecord(near=NEAR * depth, scene_depth=depth, keyframes=[0], held_out=[])
    return FinishedRun(path, [path.name], np.zeros(1), T[None], [CAMERA], record, state)


def _some_splats(path: Path) -> dict[str, NDArray[np.float32]]:
    state = read_splats(path)
    if len(state["position"]) == 0:
        raise InputError(f"{path}: the map holds no Gaussian")
    return state


def _pinhole(camera: ModelCamera, what: str) -> PinholeCamera:
    if camera.model != "PINHOLE":
        raise InputError(f"{what}: a {camera.model} camera is none of a run")
    fx, fy, cx, cy = camera.params
    return require_plausible(PinholeCamera(fx, fy, cx, cy, camera.width, camera.height), NO_DISTORTION, what)[0]


def finished_metrics(config: SceneConfig) -> dict[str, Any] | None:
    """Return the metrics of a finished run with these settings in `config.output`, None if there is none.

    A run with further maps (`tracker.maps: all`) is finished when all of them are.
    """
    try:
        require_whole(config.output)
        metrics = read_json(config.output / METRICS, METRICS)
        written = load_scene(config.output / SETTINGS)
        further = int(metrics.get("further_maps", 0))
    except (InputError, AttributeError, TypeError, ValueError):
        return None
    if not made_with(written, config):
        return None
    maps = [config.of_map(place).output / METRICS for place in range(2, 2 + further)]
    return metrics if all(file.is_file() for file in maps) else None


def made_with(written: SceneConfig, config: SceneConfig) -> bool:
    """Whether the settings that a run has written are these, as far as its map depends on them."""
    second = config.tracker.second_choice(0)
    if second is not None and second.kind == written.tracker.kind:  # the run took it
        config = config.model_copy(update={"tracker": written.tracker})
    scale = written.source.scale
    if scale != "auto":  # the run's number, which `auto` in the scene file became
        config = config.resolved(scale)
    return not differing_keys(written.model_dump(mode="json"), config.model_dump(mode="json"), FREE)

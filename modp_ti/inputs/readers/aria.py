"""Kind `aria`: poses, calibration and points from Project Aria's machine perception services (MPS)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fields.geometry.se3 import inverse_poses
from modp_ti.files.errors import InputError
from modp_ti.inputs.aria_mps import (
    CameraMounts,
    DeviceTrajectory,
    read_calibration,
    read_device_trajectory,
    read_observations,
    read_points,
)
from modp_ti.inputs.given_poses import (
    posed_images,
    solving,
)
from modp_ti.inputs.multiview.triangulation import triangulated_frames
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.point_cloud import spread_points
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.reader import TimedPosesSettings
from modp_ti.inputs.replay import PosedImage, ReplayedTracker
from modp_ti.inputs.sources.protocol import ImageSource
from modp_ti.inputs.timed_poses import rows_at_frames

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig, SourceSettings

CLOSED_LOOP, OPEN_LOOP = "closed_loop_trajectory.csv", "open_loop_trajectory.csv"
CALIBRATION = "online_calibration.jsonl"
POINTS = ("semidense_points.csv.gz", "semidense_points.csv", "global_points.csv.gz", "global_points.csv")
OBSERVATIONS = ("semidense_observations.csv.gz", "semidense_observations.csv")

# Largest time difference [s] between a frame and an observation of the tracking cameras, which run at 10 Hz.
SEEN_WITHIN = 0.11


class AriaSettings(TimedPosesSettings):
    """Trajectory and points of Project Aria's machine perception services (MPS)."""

    source_kind: ClassVar[str] = "vrs"
    file_suffixes: ClassVar[Sequence[str]] = (".vrs",)

    kind: Literal["aria"] = Field(
        default="aria", description="output of Project Aria's machine perception services (MPS)"
    )
    path: Path | None = Field(
        default=None,
        description="MPS's folder, its `slam` or `trajectory` folder, or one of the two trajectories; empty: it is "
        "searched near the images",
    )
    camera: str = Field(default="camera-rgb", description="label of the camera in online_calibration.jsonl")
    max_points: int = Field(default=2000, ge=10, description="largest number of points of a frame")
    max_inv_dist_std: float = Field(
        default=0.005, gt=0, description="largest standard deviation of a point's inverse distance [1/m]"
    )
    max_dist_std: float = Field(default=0.05, gt=0, description="largest standard deviation of a point's distance [m]")

    def open(self, scene: SceneConfig, progress: Progress | None = None) -> ReplayedTracker:
        """Open the images that have a device pose within `tracker.max_difference` of their time, in the source's order.

        The closed-loop trajectory is preferred to the open-loop one. Poses are T_world_camera = T_world_device
        T_device_camera, with T_device_camera from the online calibration nearest in time. If that file is missing, the
        calibration stored in the VRS recording is used.

        Each frame gets the sufficiently certain points that project into it. If there are observations, only points
        that the tracking cameras saw within `SEEN_WITHIN` of the frame's time are used. Without points, features are
        tracked and triangulated. The same happens with the open loop, because the points belong to the closed loop's
        world.
        """
        source = scene.source
        place = source.require_path()
        folder, file = _trajectory_file(self.path, place)
        device = read_device_trajectory(file, open_loop=file.name == OPEN_LOOP)
        calibration = folder / CALIBRATION
        mounts = read_calibration(calibration, self.camera) if calibration.is_file() else None
        images = open_source(source)
        missing = []
        if mounts is None:
            lost = f"{calibration} is missing: it would have brought where the camera {self.camera} sits on the device"
            if images.T_device_camera is None:
                raise InputError(f"{lost} (T_device_camera), without which device poses are no camera poses")
            mounts = CameraMounts(np.zeros(1), images.T_device_camera[None])
            missing.append(f"{lost} (T_device_camera) over time; the recording's own is taken")
        rows, notes = rows_at_frames(images, source, file, device.times, self)
        T_world_camera = np.stack([device.T_world_device[row] @ mounts.at(device.times[row]) for row in rows.values()])
        reader, frames = posed_images(images, source, dict(zip(rows, inverse_poses(T_world_camera), strict=True)))
        notes += [*_notes(device, None if missing else mounts, file), *missing]

        cloud = next((folder / name for name in POINTS if (folder / name).is_file()), None)
        if file.name == OPEN_LOOP or cloud is None:
            if file.name != OPEN_LOOP:
                notes.append(
                    f"{folder / POINTS[0]} is missing: it would have brought the points; features of the images are "
                    "tracked and triangulated instead"
                )
            frames = triangulated_frames(images, frames, solving(frames, source), progress)
            return ReplayedTracker(reader, frames, notes)
        numbers, xyz, total = read_points(cloud, device.world, self.max_inv_dist_std, self.max_dist_std)
        notes.append(f"{len(numbers)} of {total} points of {cloud.name} are certain enough")
        frames, note = _with_points(folder, frames, device.times[list(rows.values())], numbers, xyz, self.max_points)
        return ReplayedTracker(reader, frames, [*notes, note])

    @classmethod
    def open_images(cls, path: Path, source: SourceSettings) -> ImageSource:
        """Open the RGB camera of a VRS recording."""
        from modp_ti.inputs.sources.aria_vrs import AriaRecording

        return AriaRecording(path, source.vrs, source.vignette)


def _trajectory_file(given: Path | None, images: Path) -> tuple[Path, Path]:
    """Return the MPS folder and the trajectory file in it."""
    if given is not None and given.is_file():
        if given.name not in (CLOSED_LOOP, OPEN_LOOP):
            raise InputError(f"{given}: tracker.path must be MPS's folder, {CLOSED_LOOP} or {OPEN_LOOP}")
        return given.parent, given
    if given is not None and not given.is_dir():
        raise InputError(f"{given}: no such folder (tracker.path); it should hold what MPS wrote")
    home = images if images.is_dir() else images.parent
    roots = [given] if given is not None else [home, home.parent, images.parent / f"mps_{images.stem}_vrs"]
    folders = [folder for root in roots for folder in (root, root / "slam", root / "trajectory")]
    for name in (CLOSED_LOOP, OPEN_LOOP):
        for folder in folders:
            if (folder / name).is_file():
                return folder, folder / name
    raise InputError(
        f"{roots[0]}: holds neither {CLOSED_LOOP} nor {OPEN_LOOP}, which would have brought the poses: set "
        "tracker.path to MPS's folder"
    )


def _notes(device: DeviceTrajectory, mounts: CameraMounts | None, file: Path) -> list[str]:
    notes = []
    if file.name == OPEN_LOOP:
        notes.append(
            f"{file.name} is odometry, which drifts; MPS's points are of another world and not used: features of the "
            "images are tracked and triangulated"
        )
    if device.left_out:
        notes.append(f"{device.left_out} poses of {file.name} are of another world than most (its graph): left out")
    if mounts is not None:
        gap = max(device.times[0] - mounts.times[-1], mounts.times[0] - device.times[-1])
        if gap > 0:
            notes.append(
                f"{CALIBRATION} is of another time than {file.name} ({gap:.1f} s apart): is it of one recording?"
            )
    return notes


def _with_points(
    folder: Path,
    frames: list[PosedImage],
    times: NDArray[np.float64],
    numbers: NDArray[np.int64],
    xyz: NDArray[np.float64],
    limit: int,
) -> tuple[list[PosedImage], str]:
    """Return the frames, taken at device times (F,), with the points that they observe, and a remark for the user."""
    file = next((folder / name for name in OBSERVATIONS if (folder / name).is_file()), None)
    if file is None:
        seen = [np.arange(len(xyz))] * len(frames)
        note = (
            f"{folder / OBSERVATIONS[0]} is missing: it would have said which points were seen at which time; every "
            "point is shown that projects into the frame and that no nearer one hides"
        )
    else:
        instants, groups = read_observations(file, numbers, times.min() - SEEN_WITHIN, times.max() + SEEN_WITHIN)
        seen = []
        for time in times:
            a, b = np.searchsorted(instants, (time - SEEN_WITHIN, time + SEEN_WITHIN))
            seen.append(np.unique(np.concatenate([np.zeros(0, np.int64), *groups[a:b]])))
        note = f"points seen within {SEEN_WITHIN} s by the tracking cameras, at the pixels that they project to"
    result = [
        frame.with_points(spread_points(xyz[mine], numbers[mine], frame, limit))
        for frame, mine in zip(frames, seen, strict=True)
    ]
    if not any(len(frame.points) for frame in result):
        raise InputError(
            f"{folder}: none of the {len(xyz)} points projects into any frame: is source.intrinsics right?"
        )
    return result, note

"""Readers of the files of Project Aria's machine perception services (MPS).

These are trajectories, calibration, points and observations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import LARGEST, input_lines, parse_json
from modp_ti.files.csv_columns import read_csv_blocks
from modp_ti.files.errors import InputError
from modp_ti.files.number_rows import NumberRows
from modp_ti.files.trajectory import poses_of_quaternions
from modp_ti.inputs.timed_poses import require_rising

MICROSECONDS = 1e-6


@dataclass(frozen=True)
class DeviceTrajectory:
    """Device poses over time.

    Attributes:
        times: Times (N,) on the device clock [s], strictly increasing.
        T_world_device: Poses (N, 4, 4), device to world.
        world: Name of the world frame (`graph_uid` or `session_uid`).
        left_out: Number of poses that belong to other worlds and were dropped.
    """

    times: NDArray[np.float64]
    T_world_device: NDArray[np.float64]
    world: str
    left_out: int


@dataclass(frozen=True)
class CameraMounts:
    """Pose of a camera on the device, estimated over time.

    Attributes:
        times: Times (N,) [s].
        T_device_camera: Poses (N, 4, 4), camera to device.
    """

    times: NDArray[np.float64]
    T_device_camera: NDArray[np.float64]

    def at(self, time: float) -> NDArray[np.float64]:
        """Return the estimate (4, 4) nearest to `time` [s]."""
        return self.T_device_camera[int(np.abs(self.times - time).argmin())]


def read_device_trajectory(path: Path, open_loop: bool) -> DeviceTrajectory:
    """Read closed_loop_trajectory.csv, or open_loop_trajectory.csv, the odometry, which drifts.

    If there are several worlds (`graph_uid`; `session_uid` of the open loop), the one with most poses is used; poses of
    the others are counted in `left_out`.

    Args:
        path: The file.
        open_loop: Whether it is that of the open loop.

    Raises:
        InputError: If the file is malformed. The message names file and line. The other readers do the same.
    """
    world, frame = ("session_uid", "odometry_device") if open_loop else ("graph_uid", "world_device")
    names = [f"{axis}_{frame}" for axis in ("tx", "ty", "tz", "qx", "qy", "qz", "qw")]
    columns = {"tracking_timestamp_us": "i8", world: "U64", **dict.fromkeys(names, "f8")}
    blocks = list(read_csv_blocks(path, columns))
    if not blocks:
        raise InputError(f"{path}: holds no pose")
    table = np.concatenate([rows for _, rows in blocks])
    worlds, count = np.unique(table[world], return_counts=True)
    main = worlds[count.argmax()]
    rows = np.flatnonzero(table[world] == main)
    table = table[rows]
    times = table["tracking_timestamp_us"] * MICROSECONDS
    poses = _poses(NumberRows(path, np.stack([times, *(table[name] for name in names)], axis=1), rows + 2))
    return DeviceTrajectory(times, poses, str(main), int(count.sum() - count.max()))


def read_calibration(path: Path, label: str) -> CameraMounts:
    """Read `T_device_camera` of the camera with this label from online_calibration.jsonl."""
    numbered = enumerate(input_lines(path), start=1)
    table = np.array([(number, *_mount(line, label, path, number)) for number, line in numbered if line.strip()])
    if len(table) == 0:
        raise InputError(f"{path}: holds no calibration")
    rows = NumberRows(path, table[:, 1:], table[:, 0].astype(np.int64))
    return CameraMounts(rows.values[:, 0], _poses(rows))


def _poses(rows: NumberRows) -> NDArray[np.float64]:
    """Poses (N, 4, 4) of rows `time tx ty tz qx qy qz qw`, whose times must increase."""
    require_rising(rows.values[:, 0], rows.where)
    return poses_of_quaternions(rows.values[:, 1:4], rows.values[:, 4:], rows.where)


def _mount(line: str, label: str, path: Path, number: int) -> list[float]:
    """Parse time, translation and quaternion (x, y, z, w) of the camera from one line."""
    data, what = parse_json(line, str(path), number), f"{path}:{number}"
    cameras = data.get("CameraCalibrations") if isinstance(data, Mapping) else None
    if not isinstance(cameras, list):
        raise InputError(f"{what}: holds no `CameraCalibrations`")
    labels = [camera.get("Label") if isinstance(camera, Mapping) else None for camera in cameras]
    if label not in labels:
        known = ", ".join(str(each)[:40] for each in labels[:20])
        raise InputError(f"{what}: holds no camera {label}, only {known} (tracker.camera)")
    try:
        mount = cameras[labels.index(label)]["T_Device_Camera"]
        (x, y, z), (w, (qx, qy, qz)) = mount["Translation"], mount["UnitQuaternion"]
        row = [float(data["tracking_timestamp_us"]) * MICROSECONDS, *map(float, (x, y, z, qx, qy, qz, w))]
        if not (np.abs(row) <= LARGEST).all():
            raise ValueError
    except (KeyError, TypeError, ValueError, IndexError, OverflowError):
        raise InputError(
            f"{what}: `tracking_timestamp_us` and T_Device_Camera of {label} must be numbers: Translation [x, y, z], "
            "UnitQuaternion [w, [x, y, z]]"
        ) from None
    return row


def read_points(
    path: Path, world: str, max_inv_dist_std: float, max_dist_std: float
) -> tuple[NDArray[np.int64], NDArray[np.float64], int]:
    """Read the points of the given world that are sufficiently certain.

    Args:
        path: semidense_points.csv.gz or the older global_points.csv.gz.
        world: Name of the trajectory's world; points of other worlds are dropped.
        max_inv_dist_std: Largest standard deviation of the inverse distance [1/m].
        max_dist_std: Largest standard deviation of the distance [m].

    Returns:
        Ids (N,) of the points, increasing, their positions (N, 3), and the total number of points in the file.

    Raises:
        InputError: If no point is left.
    """
    columns = {
        "uid": "i8",
        "graph_uid": "U64",
        **dict.fromkeys(("px_world", "py_world", "pz_world", "inv_dist_std", "dist_std"), "f8"),
    }
    uid, xyz, total = [np.zeros(0, np.int64)], [np.zeros((0, 3))], 0
    for _, rows in read_csv_blocks(path, columns):
        total += len(rows)
        kept = rows[
            (rows["graph_uid"] == world)
            & (rows["inv_dist_std"] <= max_inv_dist_std)
            & (rows["dist_std"] <= max_dist_std)
        ]
        uid.append(kept["uid"].copy())  # a view of one column would keep the whole table alive
        xyz.append(np.stack([kept[name] for name in ("px_world", "py_world", "pz_world")], axis=1))
    numbers, first = np.unique(np.concatenate(uid), return_index=True)
    if len(numbers) == 0:
        raise InputError(
            f"{path}: none of its {total} points is of the trajectory's world and certain enough: raise "
            "tracker.max_inv_dist_std and tracker.max_dist_std"
        )
    return numbers, np.concatenate(xyz)[first], total


def read_observations(
    path: Path, numbers: NDArray[np.int64], first: float, last: float
) -> tuple[NDArray[np.float64], list[NDArray[np.int64]]]:
    """Read which points the device's tracking cameras saw at which time.

    Args:
        path: semidense_observations.csv.gz.
        numbers: Ids (N,) of the points of interest, increasing; others are ignored.
        first: Start of the time range of interest [s].
        last: End of the time range of interest [s].

    Returns:
        Times (T,) [s], increasing, and for each of them the observed points as indices into `numbers`.

    Raises:
        InputError: If there are no such observations.
    """
    columns = {"uid": "i8", "frame_tracking_timestamp_us": "i8"}
    times, points = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for _, rows in read_csv_blocks(path, columns):
        time, uid = rows["frame_tracking_timestamp_us"], rows["uid"]
        place = np.minimum(np.searchsorted(numbers, uid), len(numbers) - 1)
        kept = (numbers[place] == uid) & (time >= first / MICROSECONDS) & (time <= last / MICROSECONDS)
        times.append(time[kept])
        points.append(place[kept])
    time, point = np.concatenate(times), np.concatenate(points)
    if len(time) == 0:
        raise InputError(f"{path}: none of its observations is of a point that is used, at the time of the frames")
    order = np.lexsort((point, time))
    time, point = time[order], point[order]
    instants, start = np.unique(time, return_index=True)
    return instants.astype(np.float64) * MICROSECONDS, [np.unique(each) for each in np.split(point, start[1:])]

"""Kind `aria`: poses, calibration and points from Project Aria's machine perception services (MPS)."""

from __future__ import annotations

import gzip
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fields.geometry.se3 import inverse_poses
from modp_ti.files import LARGEST, input_lines, open_file, parse_json, reading
from modp_ti.files.errors import InputError
from modp_ti.files.trajectory import NumberRows, poses_of_quaternions
from modp_ti.inputs.point_cloud import spread_points
from modp_ti.inputs.posed_recording import PosedRecording
from modp_ti.inputs.reader import TimedPosesSettings
from modp_ti.inputs.sources.protocol import ImageSource
from modp_ti.inputs.timed_poses import require_rising

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import SourceSettings

CLOSED_LOOP, OPEN_LOOP = "closed_loop_trajectory.csv", "open_loop_trajectory.csv"
CALIBRATION = "online_calibration.jsonl"
POINTS = ("semidense_points.csv.gz", "semidense_points.csv", "global_points.csv.gz", "global_points.csv")
OBSERVATIONS = ("semidense_observations.csv.gz", "semidense_observations.csv")

# Largest time difference [s] between a frame and an observation of the tracking cameras, which run at 10 Hz.
SEEN_WITHIN = 0.11
MICROSECONDS = 1e-6
# Rows of a table that are read at once: the files have millions.
BLOCK = 5_000


@dataclass(frozen=True)
class Transforms:
    """Poses over time: of the device in the world, or of a camera on the device.

    Attributes:
        times: Times (N,) on the device clock [s], increasing.
        matrices: Poses (N, 4, 4).
    """

    times: NDArray[np.float64]
    matrices: NDArray[np.float64]

    def at(self, time: float) -> NDArray[np.float64]:
        """Return the pose (4, 4) nearest to `time` [s]."""
        return self.matrices[int(np.abs(self.times - time).argmin())]


class AriaSettings(TimedPosesSettings):
    """Output of Project Aria's machine perception services (MPS)."""

    in_metres: ClassVar[bool] = True
    source_kind: ClassVar[str] = "vrs"
    file_suffixes: ClassVar[Sequence[str]] = (".vrs",)

    kind: Literal["aria"] = "aria"
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

    def add_poses(self, recording: PosedRecording) -> None:
        """Give images the device pose within `max_difference` of their time.

        The closed-loop trajectory is preferred to the open-loop one. Poses are T_world_camera = T_world_device
        T_device_camera, with T_device_camera from the online calibration nearest in time. If that file is missing, the
        calibration stored in the VRS recording is used.

        Each frame gets the sufficiently certain points that project into it. If there are observations, only points
        that the tracking cameras saw within `SEEN_WITHIN` of the frame's time are used. Without points, features are
        tracked and triangulated. The same happens with the open loop, because the points belong to the closed loop's
        world.
        """
        images = recording.images
        folder, file = _trajectory_file(self.path, recording.source.require_path())
        device, world, left_out = read_device_trajectory(file, open_loop=file.name == OPEN_LOOP)
        calibration = folder / CALIBRATION
        mounts = read_calibration(calibration, self.camera) if calibration.is_file() else None
        missing = []
        if mounts is None:
            lost = f"{calibration} is missing: it would have brought where the camera {self.camera} sits on the device"
            if images.T_device_camera is None:
                raise InputError(f"{lost} (T_device_camera), without which device poses are no camera poses")
            mounts = Transforms(np.zeros(1), images.T_device_camera[None])
            missing.append(f"{lost} (T_device_camera) over time; the recording's own is taken")
        rows = self.rows_at_frames(recording, file, device.times)
        T_world_camera = np.stack([device.matrices[row] @ mounts.at(device.times[row]) for row in rows.values()])
        recording.pose(dict(zip(rows, inverse_poses(T_world_camera), strict=True)))
        recording.notes += [*_notes(device, left_out, None if missing else mounts, file), *missing]

        cloud = next((folder / name for name in POINTS if (folder / name).is_file()), None)
        if file.name == OPEN_LOOP or cloud is None:
            if file.name != OPEN_LOOP:
                recording.notes.append(
                    f"{folder / POINTS[0]} is missing: it would have brought the points; features of the images are "
                    "tracked and triangulated instead"
                )
            recording.triangulate()
            return
        numbers, xyz, total = read_points(cloud, world, self.max_inv_dist_std, self.max_dist_std)
        recording.notes.append(f"{len(numbers)} of {total} points of {cloud.name} are certain enough")
        _add_points(recording, folder, device.times[list(rows.values())], numbers, xyz, self.max_points)

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


def _notes(device: Transforms, left_out: int, mounts: Transforms | None, file: Path) -> list[str]:
    notes = []
    if file.name == OPEN_LOOP:
        notes.append(
            f"{file.name} is odometry, which drifts; MPS's points are of another world and not used: features of the "
            "images are tracked and triangulated"
        )
    if left_out:
        notes.append(f"{left_out} poses of {file.name} are of another world than most (its graph): left out")
    if mounts is not None:
        gap = max(device.times[0] - mounts.times[-1], mounts.times[0] - device.times[-1])
        if gap > 0:
            notes.append(
                f"{CALIBRATION} is of another time than {file.name} ({gap:.1f} s apart): is it of one recording?"
            )
    return notes


def _add_points(
    recording: PosedRecording,
    folder: Path,
    times: NDArray[np.float64],
    numbers: NDArray[np.int64],
    xyz: NDArray[np.float64],
    limit: int,
) -> None:
    """Give the frames, taken at device times (F,), the points that they observe."""
    file = next((folder / name for name in OBSERVATIONS if (folder / name).is_file()), None)
    if file is None:
        seen = [np.arange(len(xyz))] * len(times)
        recording.notes.append(
            f"{folder / OBSERVATIONS[0]} is missing: it would have said which points were seen at which time; every "
            "point is shown that projects into the frame and that no nearer one hides"
        )
    else:
        instants, groups = read_observations(file, numbers, times.min() - SEEN_WITHIN, times.max() + SEEN_WITHIN)
        seen = []
        for time in times:
            a, b = np.searchsorted(instants, (time - SEEN_WITHIN, time + SEEN_WITHIN))
            seen.append(np.unique(np.concatenate([np.zeros(0, np.int64), *groups[a:b]])))
        recording.notes.append(
            f"points seen within {SEEN_WITHIN} s by the tracking cameras, at the pixels that they project to"
        )
    each = iter(seen)
    if not recording.add_points(lambda frame: spread_points(xyz[mine := next(each)], numbers[mine], frame, limit)):
        raise InputError(
            f"{folder}: none of the {len(xyz)} points projects into any frame: is source.intrinsics right?"
        )


# ---- MPS's files -------------------------------------------------------------------------------------


def read_csv_blocks(path: Path, columns: Mapping[str, str]) -> Iterator[NDArray]:
    """Read the given columns of a CSV file block by block.

    Args:
        path: The CSV file; the suffix `.gz` marks a gzip file.
        columns: Name and NumPy type of each column to read. The file may have more columns, in any order.

    Yields:
        The block's rows as a structured array of `columns`.

    Raises:
        InputError: With file and line, if a column is missing from the header, a row has the wrong length, or a value
            is not a finite number; with the file, if it is cut off or cannot be read.
    """
    with reading(path), open_file(path) as stored:
        file = gzip.open(stored, "rt") if path.suffix == ".gz" else map(bytes.decode, stored)
        header = [name.strip() for name in next(iter(file), "").split(",")]
        missing = [name for name in columns if name not in header]
        if missing:
            raise InputError(f"{path}:1: the header has no column {', '.join(missing)}")
        places = [header.index(name) for name in columns]
        line = 2
        while rows := list(islice(file, BLOCK)):
            for n, row in enumerate(rows):  # a file that is cut off ends in a short row
                if row.count(",") != len(header) - 1:
                    raise InputError(f"{path}:{line + n}: has not the {len(header)} columns of the header")
            try:
                table = np.loadtxt(rows, np.dtype(list(columns.items())), delimiter=",", usecols=places, ndmin=1)
            except ValueError as error:
                raise InputError(f"{path}, in the lines from {line}: {error}") from None
            for name in (name for name in columns if table.dtype[name].kind == "f"):
                bad = np.flatnonzero(~(np.abs(table[name]) <= LARGEST))
                if len(bad):
                    raise InputError(f"{path}:{line + bad[0]}: {name} is no finite number; take the line out")
            yield table
            line += len(rows)


def read_device_trajectory(path: Path, open_loop: bool) -> tuple[Transforms, str, int]:
    """Read closed_loop_trajectory.csv, or open_loop_trajectory.csv, the odometry, which drifts.

    If there are several worlds (`graph_uid`; `session_uid` of the open loop), the one with most poses is used.

    Args:
        path: The file.
        open_loop: Whether it is that of the open loop.

    Returns:
        T_world_device, the name of the world, and the number of poses of other worlds.

    Raises:
        InputError: If the file is malformed. The message names file and line. The other readers do the same.
    """
    world, frame = ("session_uid", "odometry_device") if open_loop else ("graph_uid", "world_device")
    names = [f"{axis}_{frame}" for axis in ("tx", "ty", "tz", "qx", "qy", "qz", "qw")]
    columns = {"tracking_timestamp_us": "i8", world: "U64", **dict.fromkeys(names, "f8")}
    blocks = list(read_csv_blocks(path, columns))
    if not blocks:
        raise InputError(f"{path}: holds no pose")
    table = np.concatenate(blocks)
    worlds, count = np.unique(table[world], return_counts=True)
    main = worlds[count.argmax()]
    rows = np.flatnonzero(table[world] == main)
    table = table[rows]
    times = table["tracking_timestamp_us"] * MICROSECONDS
    poses = _poses(NumberRows(path, np.stack([times, *(table[name] for name in names)], axis=1), rows + 2))
    return Transforms(times, poses), str(main), int(count.sum() - count.max())


def read_calibration(path: Path, label: str) -> Transforms:
    """Read `T_device_camera` of the camera with this label from online_calibration.jsonl."""
    numbered = enumerate(input_lines(path), start=1)
    table = np.array([(number, *_mount(line, label, path, number)) for number, line in numbered if line.strip()])
    if len(table) == 0:
        raise InputError(f"{path}: holds no calibration")
    rows = NumberRows(path, table[:, 1:], table[:, 0].astype(np.int64))
    return Transforms(rows.values[:, 0], _poses(rows))


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
    for rows in read_csv_blocks(path, columns):
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
    for rows in read_csv_blocks(path, columns):
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

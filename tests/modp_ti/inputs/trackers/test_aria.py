"""Tracker `aria`: MPS's files give camera poses and points; what is missing is named with what it would bring."""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.protocol import Tracker
from tests.samples.filmed import Filmed, write_text
from tests.samples.trackers import write_images

WORLD = "ea7288b8-b6a0-012d-8156-257aba6bd796"
START = 149_202_610  # [us]
MOUNT = np.eye(4)
MOUNT[:3, :3] = Rotation.from_euler("xyz", [38, 3, 5], degrees=True).as_matrix()
MOUNT[:3, 3] = [-0.004, -0.012, -0.0044]

COLUMNS = "uid,graph_uid,px_world,py_world,pz_world,inv_dist_std,dist_std"


def trajectory_rows(recording, world: str = WORLD) -> list[str]:
    """Device poses each millisecond around each frame: T_world_device = T_world_camera T_camera_device."""
    rows = []
    for i, T_world_camera in enumerate(recording.poses_in_world):
        T = T_world_camera @ np.linalg.inv(MOUNT)
        pose = ",".join(f"{x:.9f}" for x in [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()])
        for shift in (-1000, 0, 1000):
            at = pose if shift == 0 else "9,9,9,0,0,0,1"  # neighbours are elsewhere: only the nearest will do
            rows.append(f"{world},{START + round(i * 1e6 / 30) + shift},1686767222002923694,{at},0,0,0,0.5")
    return rows


def write_trajectory(recording, rows: list[str], name: str = "closed_loop_trajectory.csv", frame="world_device"):
    axes = ",".join(f"{axis}_{frame}" for axis in ("tx", "ty", "tz", "qx", "qy", "qz", "qw"))
    header = f"graph_uid,tracking_timestamp_us,utc_timestamp_ns,{axes},gravity_x,gravity_y,gravity_z,quality_score"
    recording.write(f"slam/{name}", [header, *rows])


def calibration_line(time: int, mount: np.ndarray) -> str:
    x, y, z, w = Rotation.from_matrix(mount[:3, :3]).as_quat().tolist()
    camera = {"Label": "camera-rgb", "T_Device_Camera": {"Translation": mount[:3, 3].tolist()}}
    camera["T_Device_Camera"]["UnitQuaternion"] = [w, [x, y, z]]
    left = {
        "Label": "camera-slam-left",
        "T_Device_Camera": {"Translation": [0, 0, 0], "UnitQuaternion": [1, [0, 0, 0]]},
    }
    return json.dumps({"tracking_timestamp_us": time, "CameraCalibrations": [left, camera]})


def write_gz(recording, name: str, lines: list[str]) -> None:
    with gzip.open(recording.root / "slam" / name, "wt") as file:
        file.write("".join(line + "\n" for line in lines))


def point_rows(recording) -> list[str]:
    """Certain points 500, 501, ...; then one of another world and two that are not certain."""
    rows = [f"{500 + i},{WORLD},{x!r},{y!r},{z!r},0.002,0.01" for i, (x, y, z) in enumerate(recording.xyz.tolist())]
    return [
        *rows,
        "900,another-world,0,0,0,0.002,0.01",
        f"901,{WORLD},0,0,0,0.006,0.01",
        f"902,{WORLD},0,0,0,0.002,0.06",
    ]


@dataclass(frozen=True)
class Recording:
    """A folder with the images of what was filmed, and its points (P, 3)."""

    root: Path
    filmed: Filmed
    xyz: np.ndarray

    @property
    def poses_in_world(self) -> list[np.ndarray]:
        return [view.T_world_camera for view in self.filmed.views]

    def write(self, name: str, lines: list[str]) -> Path:
        write_text(self.root / name, lines)
        return self.root / name

    def open(self, kind: str, source: dict | None = None, **tracker) -> Tracker:
        K = self.filmed.K
        intrinsics = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        source = {"path": self.root / "images", "intrinsics": intrinsics, **(source or {})}
        settings = {"source": source, "tracker": {"kind": kind, **tracker}, "output": Path("out")}
        return open_tracker(SceneConfig.model_validate(settings))

    def failure(self, kind: str, **tracker) -> str:
        """The one line that the user gets."""
        with pytest.raises(InputError) as caught:
            self.open(kind, **tracker)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    def assert_frames(self, tracker: Tracker, numbers: Iterable[int], least_points: int = 20) -> None:
        """The frames of these numbers, with their poses, and points on their pixels."""
        for frame, i in zip(tracker.frames, numbers, strict=True):
            np.testing.assert_allclose(frame.T_camera_world, self.filmed.views[i].T_camera_world, atol=1e-6)
            p = frame.points.xyz @ frame.T_camera_world[:3, :3].T + frame.T_camera_world[:3, 3]
            np.testing.assert_allclose(frame.undistorter.camera.project(p), frame.points.pixels, atol=1e-3)
            assert len(frame.points) >= least_points


@pytest.fixture
def recorded(filmed, tmp_path):
    """MPS's folder `slam` beside the images, with all but the observations."""
    write_images(tmp_path, filmed)
    recording = Recording(tmp_path, filmed, filmed.points)
    write_trajectory(recording, trajectory_rows(recording))
    wrong = MOUNT.copy()
    wrong[:3, 3] += 1.0
    lines = [calibration_line(START + round(i * 1e6 / 30) + 100, MOUNT) for i in range(7)]
    recording.write("slam/online_calibration.jsonl", [calibration_line(START - 700_000, wrong), *lines])
    write_gz(recording, "semidense_points.csv.gz", [COLUMNS, *point_rows(recording)])
    return recording


CLOCK = {"time_offset": -START * 1e-6}  # the folder's images have no times of their own


def test_camera_poses_are_device_poses_times_the_mount_nearest_in_time(recorded):
    tracker = recorded.open("aria", **CLOCK)
    recorded.assert_frames(tracker, range(7))
    for frame in tracker.frames:
        assert np.array_equal(frame.points.xyz, recorded.xyz[frame.points.ids - 500]), "900 to 902 are left out"
    assert "60 of 63 points of semidense_points.csv.gz are certain enough" in tracker.notes
    assert any("semidense_observations.csv.gz is missing: it would have said" in note for note in tracker.notes)
    looser = recorded.open("aria", max_inv_dist_std=0.01, max_dist_std=0.1, **CLOCK)
    assert "62 of 63 points of semidense_points.csv.gz are certain enough" in looser.notes


def test_with_observations_a_frame_sees_what_was_seen_around_its_time(recorded):
    """Points 500 to 529 are seen at the first frame's time, 530 to 559 half a second later."""
    later = START + 500_000
    rows = [f"{500 + i},{START if i < 30 else later},serial,10.5,20.5" for i in range(60)]
    write_gz(recorded, "semidense_observations.csv.gz", ["uid,frame_tracking_timestamp_us,camera_serial,u,v", *rows])
    tracker = recorded.open("aria", **CLOCK)
    recorded.assert_frames(tracker, range(7), least_points=0)
    # Within 0.11 s of the first frame lie frames 0 to 3.
    for i, frame in enumerate(tracker.frames):
        assert (len(frame.points) > 5) == (i <= 3)
        assert set(frame.points.ids.tolist()) <= set(range(500, 530))
    rows = [f"777,{START},serial,1,1"]
    write_gz(recorded, "semidense_observations.csv.gz", ["uid,frame_tracking_timestamp_us,camera_serial,u,v", *rows])
    assert "none of its observations is of a point that is used" in recorded.failure("aria", **CLOCK)


def test_older_names_and_another_world_s_poses(recorded):
    (recorded.root / "slam" / "semidense_points.csv.gz").rename(recorded.root / "slam" / "global_points.csv.gz")
    rows = trajectory_rows(recorded)
    extra = [row.replace(WORLD, "a-second-world") for row in rows[-3:]]
    write_trajectory(recorded, rows[:-3] + extra)
    tracker = recorded.open("aria", path=recorded.root / "slam", **CLOCK)
    recorded.assert_frames(tracker, range(6))
    assert "3 poses of closed_loop_trajectory.csv are of another world than most (its graph): left out" in tracker.notes


def test_open_loop_is_read_and_said_to_drift(recorded):
    (recorded.root / "slam" / "closed_loop_trajectory.csv").unlink()
    rows = trajectory_rows(recorded)
    write_trajectory(recorded, rows, "open_loop_trajectory.csv", "odometry_device")
    file = recorded.root / "slam" / "open_loop_trajectory.csv"
    file.write_text(file.read_text().replace("graph_uid", "session_uid", 1))
    tracker = recorded.open("aria", {"stop": 3}, **CLOCK)
    expected = [view.T_camera_world for view in recorded.filmed.views[:3]]
    np.testing.assert_allclose([frame.T_camera_world for frame in tracker.frames], expected, atol=1e-6)
    assert any("odometry, which drifts" in note for note in tracker.notes)


@pytest.mark.parametrize(("name", "lost"), [("closed_loop_trajectory.csv", "poses"), ("online_calibration.jsonl", "")])
def test_a_missing_file_is_named_with_what_it_would_have_brought(recorded, name, lost):
    (recorded.root / "slam" / name).unlink()
    message = recorded.failure("aria", **CLOCK)
    assert name in message and "would have brought" in message and lost in message


def test_missing_points_are_triangulated(recorded):
    (recorded.root / "slam" / "semidense_points.csv.gz").unlink()
    tracker = recorded.open("aria", {"stop": 2}, **CLOCK)
    assert any("semidense_points.csv.gz is missing" in note for note in tracker.notes)


def test_a_faulty_row_of_the_trajectory_is_named(recorded):
    """With its line, but for text in place of a number, of which NumPy counts the rows."""
    whole = trajectory_rows(recorded)
    columns = whole[4].split(",")  # line 6 of the file
    faults = {
        "csv:6: ": [
            whole[4].rsplit(",", 1)[0],
            whole[4].replace(columns[3], "nan"),
            whole[4].replace(columns[1], str(START)),
            whole[4].replace(columns[9], "3.0"),
        ],
        "csv": [whole[4].replace(columns[3], "x1"), whole[4].replace(columns[1], "soon")],
    }
    for named, rows in faults.items():
        for row in rows:
            write_trajectory(recorded, [*whole[:4], row, *whole[5:]])
            assert f"closed_loop_trajectory.{named}" in recorded.failure("aria", **CLOCK)
    write_trajectory(recorded, [])
    assert "closed_loop_trajectory.csv" in recorded.failure("aria", **CLOCK)
    write_trajectory(recorded, whole, frame="odometry_device")
    assert "closed_loop_trajectory.csv:1: " in recorded.failure("aria", **CLOCK)


@pytest.mark.parametrize(
    "line",
    [
        '{"tracking_timestamp_us": 3, "Came',
        "{}",
        calibration_line(START, MOUNT).replace("camera-rgb", "camera-et"),
        calibration_line(START, MOUNT).replace("UnitQuaternion", "Quaternion"),
        calibration_line(START, np.diag([1, 1, 1, 1])).replace("[1.0, [", "[2.0, ["),
        calibration_line(START - 800_000, MOUNT),
    ],
)
def test_a_faulty_line_of_the_calibration_is_named(recorded, line):
    file = recorded.root / "slam" / "online_calibration.jsonl"
    first = file.read_text().splitlines()[0]
    file.write_text(f"{first}\n{line}\n")
    assert "online_calibration.jsonl:2: " in recorded.failure("aria", **CLOCK)


def test_points_that_are_cut_off_damaged_or_uncertain_are_named(recorded):
    file = recorded.root / "slam" / "semidense_points.csv.gz"
    whole = file.read_bytes()
    for damaged in (whole[: len(whole) // 2], b"uid,graph_uid\n"):
        file.write_bytes(damaged)
        assert "semidense_points.csv.gz" in recorded.failure("aria", **CLOCK)
    file.write_bytes(whole)
    assert "tracker.max_dist_std" in recorded.failure("aria", max_dist_std=0.001, **CLOCK)


def test_images_of_another_time_and_other_files_are_an_error(recorded):
    assert "tracker.time_offset" in recorded.failure("aria")
    for path in (recorded.root / "gone", recorded.write("slam/other.csv", ["x"])):
        assert "tracker.path" in recorded.failure("aria", path=path, **CLOCK)

"""What is particular to tracker `aria`: mounts, certain points, observations, and what is missing or faulty."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from tests.opening import assert_poses, off_pixels, opened, refusal
from tests.samples.filmed import Filmed, write_text
from tests.samples.kinds import write_sample
from tests.samples.trackers import ARIA_MOUNT, aria_calibration

TRAJECTORY, CALIBRATION = "closed_loop_trajectory.csv", "online_calibration.jsonl"
POINTS, OBSERVATIONS = "semidense_points.csv.gz", "semidense_observations.csv"


@pytest.fixture
def folder(filmed: Filmed, tmp_path: Path) -> Path:
    """MPS's files beside the images, with all but the observations."""
    write_sample("aria", tmp_path / "a", filmed)
    (tmp_path / "a" / OBSERVATIONS).unlink()
    return tmp_path / "a"


def lines_of(file: Path) -> list[str]:
    return file.read_text().splitlines()


def test_the_pose_and_the_mount_nearest_in_time_are_taken(folder, filmed):
    header, *rows = lines_of(folder / TRAJECTORY)
    elsewhere = ",".join(["9", "9", "9", "0", "0", "0", "1", "0.5"])
    times = {int(row.split(",")[1]): row for row in rows}
    beside = [[f"g1,{t - 1000},0,{elsewhere}", row, f"g1,{t + 1000},0,{elsewhere}"] for t, row in times.items()]
    write_text(folder / TRAJECTORY, [header, *(row for three in beside for row in three)])
    wrong = ARIA_MOUNT.copy()
    wrong[:3, 3] += 1.0
    write_text(folder / CALIBRATION, [aria_calibration(-700_000, wrong), *lines_of(folder / CALIBRATION)])
    tracker = opened(folder)
    assert_poses(tracker.frames, filmed.views)
    for frame in tracker.frames:
        assert len(frame.points) >= 20 and off_pixels(frame).max() < 1e-3
    assert any("semidense_observations.csv.gz is missing" in note for note in tracker.notes)


def test_points_of_another_world_or_that_are_not_certain_are_left_out(folder, filmed):
    more = ["900,another-world,0,0,0,0.002,0.01", "901,g1,0,0,0,0.006,0.01", "902,g1,0,0,0,0.002,0.06"]
    content = gzip.decompress((folder / POINTS).read_bytes()) + "\n".join(more).encode()
    (folder / POINTS).write_bytes(gzip.compress(content))
    tracker = opened(folder)
    assert "60 of 63 points of semidense_points.csv.gz are certain enough" in tracker.notes
    for frame in tracker.frames:
        np.testing.assert_array_equal(frame.points.xyz, filmed.points[frame.points.ids])
    looser = opened(folder, "tracker.max_inv_dist_std=0.01", "tracker.max_dist_std=0.1")
    assert "62 of 63 points of semidense_points.csv.gz are certain enough" in looser.notes
    assert "tracker.max_dist_std" in refusal(folder, "tracker.max_dist_std=0.001")


def test_with_observations_a_frame_sees_what_was_seen_around_its_time(folder):
    """Points 0 to 29 are seen at the first frame's time, the others half a second later."""
    head = "uid,frame_tracking_timestamp_us,camera_serial,u,v"
    write_text(folder / OBSERVATIONS, [head, *(f"{i},{0 if i < 30 else 500_000},serial,1,1" for i in range(60))])
    for i, frame in enumerate(opened(folder).frames):  # within 0.11 s of the first frame lie frames 0 to 3
        assert (len(frame.points) > 5) == (i <= 3)
        assert set(frame.points.ids.tolist()) <= set(range(30))
    write_text(folder / OBSERVATIONS, [head, "777,0,serial,1,1"])
    assert OBSERVATIONS in refusal(folder)


def test_older_names_and_another_world_s_poses(folder, filmed):
    (folder / POINTS).rename(folder / "global_points.csv.gz")
    lines = lines_of(folder / TRAJECTORY)
    write_text(folder / TRAJECTORY, [*lines[:-1], lines[-1].replace("g1", "a-second-world")])
    tracker = opened(folder)
    assert_poses(tracker.frames, filmed.views[:6])
    assert any(note.startswith("1 poses of closed_loop_trajectory.csv are of another world") for note in tracker.notes)


def test_open_loop_is_read_and_said_to_drift(folder, filmed):
    text = (folder / TRAJECTORY).read_text().replace("world_device", "odometry_device")
    (folder / "open_loop_trajectory.csv").write_text(text.replace("graph_uid", "session_uid"))
    (folder / TRAJECTORY).unlink()
    tracker = opened(folder, "source.stop=3")
    assert_poses(tracker.frames, filmed.views[:3])
    assert any("odometry, which drifts" in note for note in tracker.notes)


@pytest.mark.parametrize(("column", "value"), [(-1, None), (3, "nan"), (1, "0"), (9, "3.0"), (3, "x1"), (1, "soon")])
def test_a_faulty_row_of_the_trajectory_is_named(folder, column, value):
    """With its line, but for text in place of a number, of which NumPy counts the rows."""
    lines = lines_of(folder / TRAJECTORY)
    words = lines[4].split(",")
    words[column : column + 1 or None] = [] if value is None else [value]
    write_text(folder / TRAJECTORY, [*lines[:4], ",".join(words), *lines[5:]])
    assert f"{TRAJECTORY}:5: " in refusal(folder) or value in ("x1", "soon")


@pytest.mark.parametrize(
    "line",
    [
        '{"tracking_timestamp_us": 3, "Came',
        "{}",
        aria_calibration(1).replace("camera-rgb", "camera-et"),
        aria_calibration(1).replace("UnitQuaternion", "Quaternion"),
        aria_calibration(1, np.eye(4)).replace("[1.0, [", "[2.0, ["),
        aria_calibration(-1),
    ],
)
def test_a_faulty_line_of_the_calibration_is_named(folder, line):
    write_text(folder / CALIBRATION, [lines_of(folder / CALIBRATION)[0], line])
    assert f"{CALIBRATION}:2: " in refusal(folder)


def test_points_that_are_cut_off_or_of_other_columns_are_named(folder):
    whole = (folder / POINTS).read_bytes()
    for damaged in (whole[: len(whole) // 2], gzip.compress(b"uid,graph_uid\n")):
        (folder / POINTS).write_bytes(damaged)
        assert POINTS in refusal(folder)


def test_images_of_another_time_and_other_files_are_an_error(folder):
    assert "tracker.time_offset" in refusal(folder, "tracker.time_offset=50")
    write_text(folder / "other.csv", ["x"])
    for name in ("gone", "other.csv"):
        assert "tracker.path" in refusal(folder, f"tracker.path={folder / name}")

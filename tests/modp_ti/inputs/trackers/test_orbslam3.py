"""Tracker `orbslam3`: both flavours, all frames or keyframes alone."""

from __future__ import annotations

import shutil

import pytest


@pytest.fixture
def posed(recording):
    recording.write_points()
    return recording


def as_nanoseconds(line: str) -> str:
    time, rest = line.split(" ", 1)
    return f"{float(time) * 1e9:.6f} {rest}"  # as ORB-SLAM3 prints it


def test_frames_between_keyframes_are_skipped_and_counted(posed):
    lines = posed.tum_lines()
    posed.write("KeyFrameTrajectory.txt", [lines[i] for i in (0, 3, 6)])
    tracker = posed.open("orbslam3", points=posed.root / "points.txt")
    posed.assert_frames(tracker, [0, 3, 6])
    assert tracker.notes == [
        "4 of 7 images have no pose in KeyFrameTrajectory.txt: skipped (the first: view9.png)",
        "KeyFrameTrajectory.txt holds keyframes alone: give ORB-SLAM3's CameraTrajectory.txt to use the frames "
        "between them too",
    ]


def test_the_trajectory_of_all_frames_comes_first(posed):
    lines = posed.tum_lines()
    posed.write("KeyFrameTrajectory.txt", [lines[i] for i in (0, 3, 6)])
    posed.write("CameraTrajectory.txt", lines[1:])
    posed.assert_frames(posed.open("orbslam3", points=posed.root / "points.txt"), range(1, 7))
    posed.assert_frames(posed.open("orbslam3", path=posed.root, points=posed.root / "points.txt"), range(1, 7))


def test_nanoseconds_of_the_euroc_flavour_fit_images_that_are_called_by_theirs(posed):
    start = 1403636579.763555
    for i, name in enumerate(posed.names):
        shutil.move(posed.root / "images" / name, posed.root / "images" / f"{round((start + i / 20) * 1e9)}.png")
    lines = map(as_nanoseconds, posed.tum_lines(start, per_second=20.0))
    posed.write("run/f_dataset-MH01_mono.txt", lines)
    tracker = posed.open("orbslam3", path=posed.root / "run", points=posed.root / "points.txt")
    assert len(tracker) == 7
    times = [frame.timestamp for frame in tracker]
    assert times[0] == pytest.approx(start, abs=1e-6) and times[6] - times[0] == pytest.approx(0.3, abs=1e-6)


def test_of_several_named_trajectories_one_must_be_named(posed):
    for name in ("f_a.txt", "f_b.txt", "kf_a.txt"):
        posed.write(f"run/{name}", posed.tum_lines())
    assert "holds 3 trajectories" in posed.failure("orbslam3", path=posed.root / "run")
    assert "KeyFrameTrajectory.txt" in posed.failure("orbslam3")


def test_wrong_line_is_named_in_nanoseconds_too(posed):
    lines = [as_nanoseconds(line) for line in posed.tum_lines(1403636579.0)]
    posed.write("CameraTrajectory.txt", [lines[1], lines[0]])
    assert "CameraTrajectory.txt:2: time 1403636579000" in posed.failure("orbslam3")

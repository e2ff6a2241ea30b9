"""What is particular to trackers with a file of poses: which image has which pose, and what is wrong by line."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from modp_ti.inputs.inspection.geometry import judge_geometry, measure_geometry
from modp_ti.inputs.inspection.survey import survey
from modp_ti.inputs.replay import ReplayedTracker
from tests.opening import assert_poses, off_pixels, opened, refusal
from tests.samples.filmed import OPENGL, Filmed, write_text
from tests.samples.kinds import write_sample

COUNT = 7


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "a"


def assert_frames(tracker: ReplayedTracker, filmed: Filmed, numbers) -> None:
    """The frames are those of these numbers, with points on their pixels."""
    assert_poses(tracker.frames, [filmed.views[i] for i in numbers])
    for frame in tracker.frames:
        assert len(frame.points) >= 20 and off_pixels(frame).max() < 1e-3


def changed_line(file: Path, number: int, line: str) -> None:
    lines = file.read_text().splitlines()
    lines[number] = line
    write_text(file, lines)


@pytest.mark.parametrize("kind", ["matrices", "tanksandtemples"])
@pytest.mark.parametrize(
    ("fault", "wrongly"),
    [
        (None, lambda T: T),
        ("opengl_axes", lambda T: T @ OPENGL),
        ("inverse_poses", np.linalg.inv),
        ("inverse_poses_with_opengl_axes", lambda T: np.linalg.inv(T @ OPENGL)),
    ],
)
def test_a_wrong_convention_is_found_by_check(filmed, folder, untriangulated, kind, fault, wrongly):
    """The images show it."""
    views = [view.posed(wrongly(view.T_world_camera)) for view in filmed.views]
    write_sample(kind, folder, Filmed(views, filmed.points, filmed.names))
    found = list(judge_geometry(measure_geometry(survey(opened(folder, "tracker.points=null"), 4, lambda _: None))))
    assert [finding.code for finding in found] == ([fault] if fault else [])


def test_image_and_pose_are_joined_by_the_nearest_time_within_the_limit(filmed, folder):
    write_sample("tum", folder, filmed)
    lines = filmed.tum_lines(first_time=100.009)
    write_text(folder / "trajectory.txt", [lines[i] for i in (0, 1, 3, 4, 6)])
    tracker = opened(folder, "tracker.time_offset=-100")
    assert_frames(tracker, filmed, [0, 1, 3, 4, 6])
    assert tracker.notes == [f"2 of 7 images have no pose in trajectory.txt: skipped (the first: {filmed.names[2]})"]
    assert "within 0.005 s" in refusal(folder, "tracker.time_offset=-100", "tracker.max_difference=0.005")


@pytest.mark.parametrize(
    ("times", "fps", "notes"),
    [
        ([0, 1, 2, 3, 4, 5, 6], 30, 1),
        ([1, 2, 3, 4, 5, 6, 7], 30, 1),
        ([0, 1, 2, 3, 4, 5, 6], 1, 0),
        ([round(1000 * i / 30) for i in range(7)], 30, 1),
        ([1e9 * i / 30 for i in range(7)], 30, 1),
    ],
    ids=["frames from 0", "frames from 1", "seconds", "ms", "ns"],
)
def test_times_that_are_no_seconds_are_recognised_and_said(filmed, folder, times, fps, notes):
    write_sample("tum", folder, filmed)
    lines = [f"{time} {line.split(' ', 1)[1]}" for time, line in zip(times, filmed.tum_lines(), strict=True)]
    write_text(folder / "trajectory.txt", lines)
    tracker = opened(folder, f"source.fps={fps}")
    assert_frames(tracker, filmed, range(COUNT))
    assert len(tracker.notes) == notes


def test_frames_of_a_place_keep_the_same_points_where_there_are_too_many(filmed, folder):
    write_sample("tum", folder, filmed)
    kept = [set(frame.points.ids.tolist()) for frame in opened(folder, "tracker.max_points=15").frames]
    assert [len(each) for each in kept] == [15] * COUNT
    assert len(set.union(*kept)) < 30, "drawn for each frame alone it would be most of the 60"


@pytest.mark.parametrize(
    ("kind", "file", "line", "text", "said"),
    [
        ("tum", "trajectory.txt", 3, "0.1 1 2 3 0 0 1", ":4: holds 7 columns instead of 8"),
        ("tum", "trajectory.txt", 3, "0.1 1 2 three 0 0 0 1", ":4: not a row of numbers"),
        ("tum", "trajectory.txt", 3, "0.1 1 2 3 0.5 0.5 0.5 0.7", ":4: the quaternion"),
        ("tum", "trajectory.txt", 3, "0.01 1 2 3 0 0 0 1", ":4: time 0.010000 does not lie after"),
        ("tum", "trajectory.txt", 3, "1 0 0 0 0 1 0 0 0 0 1 0", "tracker.kind: matrices"),
        ("tum", "points.txt", 0, "1 2", "points.txt:1"),
        ("matrices", "poses.txt", 3, "1 0 0", "poses.txt:4: holds 3 columns instead of 12"),
        ("matrices", "poses.txt", 3, "1 0 0 0 0 1 0 0 0 0 2 0", "poses.txt:4: the pose is no rigid motion"),
        ("replica", "traj.txt", 2, "1 0 0 0 0 1 0 0 0 0 -1 0 0 0 0 1", "traj.txt:3: the pose mirrors"),
        ("replica", "traj.txt", 2, "1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1", "traj.txt:3: the last row"),
        ("sevenscenes", "seq/frame-000002.pose.txt", 0, "1 0 0", "frame-000002.pose.txt:1"),
        ("tanksandtemples", "scene.log", 2, "1 0 0", "scene.log:3: must be 4 finite numbers"),
        ("tanksandtemples", "scene.log", 5, "0 1 0", "scene.log:10"),
        ("tanksandtemples", "scene.log", 34, "", "scene.log: is cut off"),
        ("modp", "point_cloud/point_cloud_4.txt", 1, "1 nan 3", "point_cloud_4.txt:2: holds NaN"),
    ],
)
def test_a_wrong_line_is_named(filmed, folder, kind, file, line, text, said):
    write_sample(kind, folder, filmed)
    changed_line(folder / file, line, text)
    assert said in refusal(folder)


def test_lines_of_a_lost_tracker_are_left_out(filmed, folder):
    write_sample("tum", folder, filmed)
    lost = ["0.001 0 0 0 0 0 0 0", *filmed.tum_lines(), "9 nan 0 0 0 0 0 1"]
    write_text(folder / "trajectory.txt", [*lost, *(f"{10 + i} 0 0 0 0 0 0 1" for i in range(20))])
    tracker = opened(folder)
    assert_frames(tracker, filmed, range(COUNT))
    assert any(note.startswith("2 of") for note in tracker.notes)


def test_points_that_no_frame_sees_are_refused(filmed, folder):
    write_sample("tum", folder, filmed)
    write_text(folder / "points.txt", ["0 0 -900"])
    assert "camera to world" in refusal(folder)


@pytest.mark.parametrize("kind", ["tum", "modp", "matrices", "replica"])
def test_a_file_is_found_near_the_images_or_in_the_folder_that_is_given(filmed, folder, kind):
    write_sample(kind, folder, filmed)
    file = next(file for name in ("trajectory.*", "poses.txt", "traj.txt") for file in folder.glob(name))
    (folder / "elsewhere").mkdir()
    (folder / "point_cloud").mkdir(exist_ok=True)
    shutil.copy(file, folder / "elsewhere")
    shutil.copytree(folder / "point_cloud", folder / "elsewhere/point_cloud")
    file.unlink()
    for place in (folder / "elsewhere", folder / "elsewhere" / file.name):
        assert_frames(opened(folder, f"tracker.path={place}"), filmed, range(COUNT))
    assert "set tracker.path to" in refusal(folder)
    assert "no such file (tracker.path)" in refusal(folder, f"tracker.path={folder / 'gone.txt'}")


def test_of_several_files_one_must_be_named(filmed, folder):
    write_sample("tanksandtemples", folder, filmed)
    shutil.copy(folder / "scene.log", folder / "other.log")
    assert "tracker.path" in refusal(folder)
    assert_frames(opened(folder, f"tracker.path={folder / 'scene.log'}"), filmed, range(COUNT))


def test_images_that_are_not_registered_are_skipped_and_poses_of_others_told(filmed, folder):
    write_sample("tanksandtemples", folder, filmed)
    changed_line(folder / "scene.log", 5, "1 -1 0")
    changed_line(folder / "scene.log", 30, "20 20 0")
    tracker = opened(folder)
    assert_frames(tracker, filmed, [0, 2, 3, 4, 5])
    assert any("has poses of 21 images, there are 7" in note for note in tracker.notes)


@pytest.mark.parametrize("columns", [12, 16])
def test_matrices_belong_to_the_images_of_their_positions(filmed, folder, columns):
    write_sample("matrices", folder, filmed)
    lines = [" ".join(map(repr, view.T_world_camera.ravel()[:columns].tolist())) for view in filmed.views]
    write_text(folder / "poses.txt", lines[:5])
    assert_frames(opened(folder), filmed, range(5))
    assert_frames(opened(folder, "source.start=2", "source.step=2"), filmed, [2, 4])


def test_orbslam3_keyframes_serve_where_there_are_not_all_frames(filmed, folder):
    write_sample("orbslam3", folder, filmed)
    (folder / "run").mkdir()
    lines = (folder / "CameraTrajectory.txt").read_text().splitlines()
    (folder / "CameraTrajectory.txt").rename(folder / "run/f_dataset-MH01_mono.txt")
    write_text(folder / "KeyFrameTrajectory.txt", [lines[i] for i in (0, 3, 6)])
    tracker = opened(folder, "tracker.time_offset=-1400000000", "source.fps=20")
    assert_frames(tracker, filmed, [0, 3, 6])
    assert any("keyframes alone" in note for note in tracker.notes)
    assert_frames(opened(folder, f"tracker.path={folder / 'run'}", "source.fps=20"), filmed, range(COUNT))


@pytest.mark.slow
def test_sevenscenes_poses_are_adjusted_to_the_images_unless_told_not_to(filmed, folder):
    """They are those of the depth camera."""
    write_sample("sevenscenes", folder, filmed)
    given = opened(folder)
    assert any("those of the depth camera" in note for note in given.notes)
    adjusted = opened(folder, "tracker.points=null")
    assert any("bundle adjusted" in note for note in adjusted.notes)
    for frame, one, view in zip(given.frames, adjusted.frames, filmed.views, strict=True):
        assert not np.array_equal(one.T_camera_world, frame.T_camera_world)
        np.testing.assert_allclose(one.T_camera_world, view.T_camera_world, atol=0.03)


def test_a_point_of_the_release_has_one_number_in_all_frames_and_frames_may_have_none(filmed, folder):
    write_sample("modp", folder, filmed)
    number: dict[tuple[float, ...], int] = {}
    for frame in opened(folder).frames[:-1]:  # the array holds float32
        for one, xyz in zip(frame.points.ids.tolist(), map(tuple, frame.points.xyz.tolist()), strict=True):
            assert number.setdefault(xyz, one) == one
    assert len(set(number.values())) == len(number)
    (folder / "point_cloud/point_cloud_2.txt").unlink()
    (folder / "point_cloud/point_cloud_3.txt").write_text("")
    tracker = opened(folder)
    assert [len(frame.points) > 0 for frame in tracker.frames] == [True, True, False, False, True, True, True]
    assert any("1 frames have no file of points" in note for note in tracker.notes)
    (folder / "trajectory.json").rename(folder / "trajectory_orb.json")
    (folder / "point_cloud").rename(folder / "orb_point_clouds")
    assert len(opened(folder).frames) == COUNT


@pytest.mark.parametrize(
    "array",
    [np.zeros((5, 2)), np.array([[0, 0, 1.0], [0, np.inf, 1]]), np.array([{"a": 1}], dtype=object)],
    ids=["shape", "infinite", "pickled"],
)
def test_arrays_that_are_no_points_are_refused(filmed, folder, array):
    write_sample("modp", folder, filmed)
    np.save(folder / "point_cloud/point_cloud_6.npy", array, allow_pickle=True)  # never unpickled
    assert "point_cloud_6.npy" in refusal(folder)

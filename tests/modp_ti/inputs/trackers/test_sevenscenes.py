"""Tracker `sevenscenes`: a pose file beside each image, and the word that it is the depth camera's."""

from __future__ import annotations

import shutil

import numpy as np
import pytest


@pytest.fixture
def posed(recording):
    images = recording.root / "images"
    for i, name in enumerate(recording.names):
        shutil.move(images / name, images / f"frame-{i:06d}.color.png")
    recording.names[:] = [f"frame-{i:06d}.color.png" for i in range(7)]
    write_poses(recording)
    recording.write_points()
    return recording


def write_poses(recording, folder: str = "poses") -> None:
    for i, T in enumerate(recording.poses_in_world):
        rows = ["\t".join(f"{number:.9e}" for number in row) + "\t" for row in T]  # as the data set writes them
        recording.write(f"{folder}/frame-{i:06d}.pose.txt", rows)


def test_poses_are_found_beside_the_images_or_in_a_folder_of_their_own(posed):
    points = posed.root / "points.txt"
    # Intrinsics are given: source.kind images, whatever 7-Scenes' own camera is.
    posed.assert_frames(posed.open("sevenscenes", points=points), range(7))
    shutil.rmtree(posed.root / "poses")
    assert "holds no pose of any of the 7 frames" in posed.failure("sevenscenes")
    write_poses(posed, "elsewhere")
    posed.assert_frames(posed.open("sevenscenes", path=posed.root / "elsewhere", points=points), range(7))
    write_poses(posed, "images")
    tracker = posed.open("sevenscenes", points=points)
    posed.assert_frames(tracker, range(7))
    assert any("those of the depth camera" in note for note in tracker.notes)


@pytest.mark.slow
def test_poses_are_adjusted_to_the_images_unless_told_not_to(posed):
    given = posed.open("sevenscenes", adjust=False)
    assert any("nothing here knows by how much" in note for note in given.notes)
    adjusted = posed.open("sevenscenes")
    assert any("the poses are bundle adjusted" in note for note in adjusted.notes)
    assert not any("nothing here knows" in note for note in adjusted.notes)
    for frame, one, other in zip(given.frames, adjusted.frames, posed.T_camera_world, strict=True):
        np.testing.assert_allclose(frame.T_camera_world, other, atol=1e-6)
        # exact poses stay within what the images can tell
        assert not np.array_equal(one.T_camera_world, frame.T_camera_world)
        np.testing.assert_allclose(one.T_camera_world, other, atol=0.03)


def test_frames_without_a_pose_are_skipped_and_counted(posed):
    (posed.root / "poses" / "frame-000003.pose.txt").unlink()
    tracker = posed.open("sevenscenes", points=posed.root / "points.txt")
    posed.assert_frames(tracker, [0, 1, 2, 4, 5, 6])
    assert "1 of 7 images have no pose in poses: skipped (the first: frame-000003.color.png)" in tracker.notes


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda rows: rows[:3], ["frame-000002.pose.txt:3", "3 rows instead of the 4"]),
        (lambda rows: [rows[0], rows[1][:3], *rows[2:]], ["frame-000002.pose.txt:2", "3 columns instead of 4"]),
        (lambda rows: [rows[0], [np.nan, *rows[1][1:]], *rows[2:]], ["frame-000002.pose.txt:2", "NaN"]),
        (lambda rows: [2 * rows[0], *rows[1:]], ["frame-000002.pose.txt", "no rigid motion"]),
        (lambda rows: [], ["frame-000002.pose.txt: holds no row"]),
    ],
)
def test_wrong_pose_file_is_named(posed, change, parts):
    rows = change(list(posed.poses_in_world[2]))
    posed.write("poses/frame-000002.pose.txt", [" ".join(map(str, row)) for row in rows])
    message = posed.failure("sevenscenes")
    for part in parts:
        assert part in message


def test_missing_folder_is_named(posed):
    assert "no such folder (tracker.path)" in posed.failure("sevenscenes", path=posed.root / "gone")

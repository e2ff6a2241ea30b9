"""Tracker `replica`: a matrix a line, for the frame of that number."""

from __future__ import annotations

import shutil

import numpy as np
import pytest


@pytest.fixture
def posed(recording):
    """Image n is called frame00000n; view8 is frame 0."""
    results = recording.root / "results"
    results.mkdir()
    for i, name in enumerate(recording.names):
        shutil.move(recording.root / "images" / name, results / f"frame{i:06d}.png")
    recording.names[:] = [f"frame{i:06d}.png" for i in range(7)]
    (recording.root / "images").rmdir()
    results.rename(recording.root / "images")
    recording.write("traj.txt", lines(recording))
    recording.write_points()
    return recording


def lines(recording) -> list[str]:
    return [" ".join(f"{number:.12e}" for number in T.ravel()) for T in recording.poses_in_world]


def test_every_image_has_the_line_of_its_number(posed):
    points = posed.root / "points.txt"
    posed.assert_frames(posed.open("replica", points=points), range(7))
    (posed.root / "images" / posed.names[2]).unlink()
    posed.assert_frames(posed.open("replica", points=points), [0, 1, 3, 4, 5, 6])
    posed.write("traj.txt", lines(posed)[:5])
    tracker = posed.open("replica", points=points)
    posed.assert_frames(tracker, [0, 1, 3, 4])
    assert tracker.notes == ["2 of 6 images have no pose in traj.txt: skipped (the first: frame000005.png)"]


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda T: T.ravel()[:12], ["traj.txt:3", "12 columns instead of 16"]),
        (lambda T: np.where(np.eye(4, k=3) > 0, np.nan, T).ravel(), ["traj.txt:3", "NaN"]),
        (lambda T: (T @ np.diag([1.1, 1, 1, 1])).ravel(), ["traj.txt:3", "no rigid motion"]),
        (lambda T: (T @ np.diag([-1, 1, 1, 1])).ravel(), ["traj.txt:3", "mirrors"]),
        (lambda T: (T + np.diag([0, 0, 0, 1])).ravel(), ["traj.txt:3", "last row"]),
    ],
)
def test_wrong_line_is_named(posed, change, parts):
    text = lines(posed)
    text[2] = " ".join(map(str, change(posed.poses_in_world[2])))
    posed.write("traj.txt", text)
    message = posed.failure("replica")
    for part in parts:
        assert part in message


def test_images_without_a_number_or_a_line_are_an_error(posed):
    posed.write("traj.txt", lines(posed)[:1])
    assert "none has a line" in posed.failure("replica", {"start": 3})
    shutil.move(posed.root / "images" / posed.names[0], posed.root / "images" / "first.png")
    assert "first.png: the name ends in no number" in posed.failure("replica")
    posed.write("traj.txt", [])
    assert "traj.txt: holds no row of a 4x4 matrix" in posed.failure("replica")
    (posed.root / "traj.txt").unlink()
    assert "set tracker.path to Replica's traj.txt" in posed.failure("replica")

"""Trackers `matrices` and `tanksandtemples`: matrices in the order of the images."""

from __future__ import annotations

import numpy as np
import pytest

from modp_ti.inputs import posed_recording
from modp_ti.inputs.inspection.geometry import judge_geometry, measure_geometry
from modp_ti.inputs.inspection.survey import survey

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def log(recording, unregistered: tuple[int, ...] = (), wrongly=lambda T: T) -> list[str]:
    """A `.log` of the recording, whose images of these numbers have no pose, and the others a changed one."""
    lines = []
    for n, T in enumerate(map(wrongly, recording.poses_in_world)):
        lines.append(f"{n} {-1 if n in unregistered else n} 0")
        T = np.eye(4) if n in unregistered else T
        lines += [" ".join(f"{value:.12f}" for value in row) for row in T]
    return lines


def rows(recording, count: int, wrongly=lambda T: T) -> list[str]:
    return [" ".join(f"{value:.12e}" for value in wrongly(T).ravel()[:count]) for T in recording.poses_in_world]


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
def test_a_wrong_convention_is_found_by_check(recording, monkeypatch, kind, fault, wrongly):
    """The images tell it. Triangulation, which finds no points with wrong poses, would take seconds."""
    monkeypatch.setattr(posed_recording, "triangulated_frames", lambda _, frames, *__: frames)
    lines = rows(recording, 12, wrongly) if kind == "matrices" else log(recording, wrongly=wrongly)
    recording.write("poses.txt" if kind == "matrices" else "scene.log", lines)
    found = list(judge_geometry(measure_geometry(survey(recording.open(kind), 4, lambda _: None))))
    assert [finding.code for finding in found] == ([fault] if fault else [])


@pytest.mark.parametrize("count", [12, 16])
def test_every_image_has_the_line_of_its_position(recording, count):
    recording.write("poses.txt", rows(recording, count))
    points = recording.write_points()
    recording.assert_frames(recording.open("matrices", points=points), range(7))
    recording.assert_frames(recording.open("matrices", {"start": 2, "step": 2}, points=points), [2, 4, 6])
    recording.write("poses.txt", rows(recording, count)[:5])
    tracker = recording.open("matrices", points=points)
    recording.assert_frames(tracker, range(5))
    assert tracker.notes == ["2 of 7 images have no pose in poses.txt: skipped (the first: view13.png)"]


def test_images_that_are_not_registered_are_skipped(recording):
    recording.write("scene.log", log(recording, unregistered=(1, 4)))
    tracker = recording.open("tanksandtemples", points=recording.write_points())
    recording.assert_frames(tracker, [0, 2, 3, 5, 6])
    assert tracker.notes == ["2 of 7 images have no pose in scene.log: skipped (the first: view9.png)"]


def test_poses_of_images_that_are_not_there_are_told(recording):
    lines = log(recording)
    lines[30] = "20 20 0"
    recording.write("scene.log", lines)
    (note, more) = recording.open("tanksandtemples", points=recording.write_points()).notes
    assert "1 of 7 images have no pose" in note
    assert more == "scene.log has poses of 21 images, there are 7: do they belong together?"


@pytest.mark.parametrize(
    ("line", "text", "said"),
    [
        (2, "1 0 0", ":3: must be 4 finite numbers"),
        (5, "1 1", ":6: must be 3 finite numbers"),
        (2, "1 0 0 nan", ":3: must be 4 finite numbers"),
        (5, "-1 1 0", ":10: the block above does not begin with the position of an image"),
        (5, "0 1 0", ":10: image 0 has a pose already"),
        (9, "0 0 0 2", ":10: the last row of the pose must be 0 0 0 1"),
    ],
)
def test_wrong_line_of_a_log_is_named(recording, line, text, said):
    lines = log(recording)
    lines[line] = text
    recording.write("scene.log", lines)
    assert "scene.log" + said in recording.failure("tanksandtemples")


def test_a_log_that_is_cut_off_or_missing_is_an_error(recording):
    recording.write("scene.log", log(recording)[:-1])
    assert "scene.log: is cut off" in recording.failure("tanksandtemples")
    recording.write("other.log", log(recording))
    assert "holds 2 files .log: name one of them in tracker.path" in recording.failure("tanksandtemples")
    assert "no such file" in recording.failure("tanksandtemples", path=recording.root / "gone.log")


def test_wrong_line_of_matrices_is_named(recording):
    text = rows(recording, 12)
    text[3] += " 1"
    recording.write("poses.txt", text)
    assert "poses.txt:4: holds 13 columns instead of 12" in recording.failure("matrices")
    text[3] = rows(recording, 12)[3].replace(" ", " 7", 1)
    recording.write("poses.txt", text)
    assert "poses.txt:4: the pose is no rigid motion" in recording.failure("matrices")

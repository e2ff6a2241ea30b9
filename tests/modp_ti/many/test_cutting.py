"""Where a recording is cut, and how far its parts overlap."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera
from modp_ti.engine.parts import MARGIN, SEES_TOO, SLACK, cut
from modp_ti.files.errors import InputError
from pipelines.select.keyframes import SeenPoints, covisibility

CAMERA = PinholeCamera(60.0, 60.0, 40.0, 30.0, 80, 60)


def walk(frames: int, step: float = 0.05, door: int | None = None) -> list[SeenPoints]:
    """Views of a wall by a camera that moves along it. At the frame `door`, it comes to another wall far away."""
    wall = np.stack([*np.meshgrid(np.arange(-3.0, 200.0, 0.25), np.arange(-1.0, 1.1, 0.5))], axis=-1).reshape(-1, 2)
    views = []
    for index in range(frames):
        T = np.eye(4)
        T[0, 3] = -step * index - (100.0 if door is not None and index >= door else 0.0)
        seen = np.column_stack([wall, np.full(len(wall), 2.0)])
        local = seen + T[:3, 3]
        views.append(SeenPoints(CAMERA, T, seen[CAMERA.contains(CAMERA.project(local))]))
    return views


@pytest.mark.parametrize(("frames", "parts"), [(16, 2), (100, 2), (101, 4), (97, 7)])
def test_every_frame_belongs_to_one_part_of_about_the_same_length(frames: int, parts: int) -> None:
    found = cut(walk(frames), parts)
    assert [part.number for part in found] == list(range(1, parts + 1))
    assert [frame for part in found for frame in part.own] == list(range(frames))
    longest = frames / parts
    assert max(abs(len(part.own) - longest) for part in found) <= 2 * SLACK * longest + 1


def test_neighbours_share_the_frames_around_a_cut_and_no_others() -> None:
    views = walk(200)
    found = cut(views, 4)
    most = max(int(MARGIN * 50), 1)
    assert (found[0].frames.start, found[-1].frames.stop) == (0, 200)
    for before, after in pairwise(found):
        assert before.own.stop == after.own.start
        for beyond in (before.frames.stop - before.own.stop, after.own.start - after.frames.start):
            assert beyond == most
    # A fast camera sees less of what is at the cut.
    for part in cut(walk(200, step=0.5), 4)[1:]:
        for frame in range(part.frames.start, part.own.start):
            assert covisibility(walk(200, step=0.5)[frame], walk(200, step=0.5)[part.own.start]) >= SEES_TOO
        assert part.own.start - part.frames.start < most


@pytest.mark.parametrize("door", [46, 50, 54])
def test_a_cut_is_made_where_the_camera_comes_to_another_place(door: int) -> None:
    first, second = cut(walk(100, door=door), 2)
    assert (first.own.stop, second.own.start) == (door, door)
    assert (first.frames, second.frames) == (first.own, second.own), "neither sees what the other sees"


def test_a_recording_that_is_too_short_is_refused_with_what_would_do() -> None:
    with pytest.raises(InputError, match="has 20 frames, too few for 3 parts: take at most 2 parts"):
        cut(walk(20), 3)
    with pytest.raises(InputError, match="has 9 frames, too few for 2 parts: take no parts"):
        cut(walk(9), 2)

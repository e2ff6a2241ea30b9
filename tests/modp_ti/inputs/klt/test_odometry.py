"""The odometry over made sequences with known poses: what it follows and survives, and how it joins maps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from modp_ti.inputs.klt.map_joining import MapJoining
from modp_ti.inputs.klt.recognition import Recognition
from tests.modp_ti.inputs.klt.conftest import BLACK, BoxRoom, Walk, followed, turn_on_the_spot, turning_walk
from tests.room import look_at

pytestmark = pytest.mark.slow

Sequence = tuple[list[NDArray[np.uint8]], list[NDArray[np.float64] | None]]
SEQUENCES: dict[str, tuple[float, Callable[[BoxRoom, Walk], Sequence]]] = {}


def sequence(largest_error: float) -> Callable[[Any], Any]:
    """A sequence of grey images with their poses, None where there is nothing to be placed by; all others must be."""

    def kept(make: Callable[[BoxRoom, Walk], Sequence]) -> None:
        SEQUENCES[make.__name__] = largest_error, make

    return kept


@sequence(0.015)  # of 1.8 m; 0.007 at most
def every_frame_of_a_walk(room: BoxRoom, walk: Walk) -> Sequence:
    return walk.grey, [*walk.poses]


@sequence(0.02)
def a_turn_on_the_spot_before_the_walk(room: BoxRoom, walk: Walk) -> Sequence:
    eye, target = np.linalg.inv(walk.poses[0])[:3, 3], np.array([-1.0, 3.0, 1.04])
    turns = [look_at(eye, target + np.array([x, 0.0, 0.0])) for x in np.linspace(-1.0, 0.0, 12, endpoint=False)]
    return [*map(room.grey, turns), *walk.grey[:35]], [*turns, *walk.poses[:35]]


@sequence(0.02)
def black_frames(room: BoxRoom, walk: Walk) -> Sequence:
    greys = [BLACK, BLACK, *walk.grey[:30], BLACK, BLACK, BLACK, *walk.grey[27:50]]
    return greys, [None, None, *walk.poses[:30], None, None, None, *walk.poses[27:50]]


@sequence(0.02)
def a_step_of_60_pixels_that_only_features_cross(room: BoxRoom, walk: Walk) -> Sequence:
    order = [*range(26), *range(50, 60)]
    return [walk.grey[i] for i in order], [walk.poses[i] for i in order]


@sequence(0.2)  # of 1.4 m; 0.03 to 0.12, as the size of what is seen after the turn is assumed
def a_turn_of_96_degrees_on_the_spot_within_the_walk(room: BoxRoom, walk: Walk) -> Sequence:
    poses = [*walk.poses[:30], *turn_on_the_spot(walk.poses[29], 96.0, 16)]
    return [*map(room.grey, poses)], [*poses]


@sequence(0.2)
def a_turn_of_60_degrees_in_4_frames(room: BoxRoom, walk: Walk) -> Sequence:
    poses = [*walk.poses[:30], *turn_on_the_spot(walk.poses[29], 60.0, 4)]
    return [*map(room.grey, poses)], [*poses]


@sequence(0.02)
def light_that_changes(room: BoxRoom, walk: Walk) -> Sequence:
    return [lit(grey, 0.8 + 0.3 * np.sin(i / 4)) for i, grey in enumerate(walk.grey)], [*walk.poses]


@sequence(0.02)
def four_times_less_light_from_one_frame_to_the_next(room: BoxRoom, walk: Walk) -> Sequence:
    return [lit(grey, 0.25 if 30 <= i < 40 else 1.0) for i, grey in enumerate(walk.grey)], [*walk.poses]


@sequence(0.02)
def black_frames_before_the_map_has_begun(room: BoxRoom, walk: Walk) -> Sequence:
    dark = range(4, 8)
    greys = [BLACK if i in dark else grey for i, grey in enumerate(walk.grey[:35])]
    return greys, [None if i in dark else T for i, T in enumerate(walk.poses[:35])]


@sequence(0.03)
def bands_of_light_that_wander_over_the_rows(room: BoxRoom, walk: Walk) -> Sequence:
    rows = np.arange(240)[:, None] / 100.0
    bands = [0.75 + 0.3 * np.sin(2 * np.pi * (rows + 0.37 * i)) for i in range(60)]
    return [lit(grey, band) for grey, band in zip(walk.grey, bands, strict=True)], [*walk.poses]


@sequence(0.02)
def frames_of_nothing_but_blur(room: BoxRoom, walk: Walk) -> Sequence:
    kernel, blurred = np.full((81, 81), 1 / 81**2, np.float32), range(30, 36)
    greys = [cv2.filter2D(grey, -1, kernel) if i in blurred else grey for i, grey in enumerate(walk.grey)]
    return greys, [None if i in blurred else T for i, T in enumerate(walk.poses)]


@sequence(0.03)
def something_as_wide_as_a_third_that_walks_through_the_picture(room: BoxRoom, walk: Walk) -> Sequence:
    walker = walk.grey[0][:, 100:205][:, ::-1]
    wide = [np.pad(grey, ((0, 0), (150, 250))) for grey in walk.grey]
    for i, grey in enumerate(wide):
        grey[:, 8 * i : 8 * i + 105] = walker
    return [np.ascontiguousarray(grey[:, 150:470]) for grey in wide], [*walk.poses]


@sequence(0.03)  # of 4.8 m; 0.010 to 0.012
def forward_through_a_corridor(room: BoxRoom, walk: Walk) -> Sequence:
    return _forward(replace(room, low=np.array([-1.5, -5.0, 0.0]), high=np.array([1.5, 40.0, 3.0]), fineness=60), 0.08)


@sequence(0.08)  # of 7.2 m; 0.030
def forward_over_a_plain_to_what_is_far_away(room: BoxRoom, walk: Walk) -> Sequence:
    low, high = np.array([-80.0, -20.0, 0.0]), np.array([80.0, 90.0, 60.0])
    return _forward(replace(room, low=low, high=high, fineness=60), 0.12)


def _forward(room: BoxRoom, step: float) -> Sequence:
    t = np.arange(60)
    eyes = np.stack([0.1 * np.sin(0.2 * t), step * t, 1.8 + 0.05 * np.sin(0.15 * t)], axis=1)
    aims = eyes + np.stack([0.02 * np.sin(0.1 * t), np.ones(60), 0.01 * np.cos(0.1 * t) - 0.08], axis=1)
    poses = [look_at(eye, aim) for eye, aim in zip(eyes, aims, strict=True)]
    return [*map(room.grey, poses)], [*poses]


def lit(grey: NDArray[np.uint8], gain: NDArray[np.float64] | float) -> NDArray[np.uint8]:
    return np.clip(grey * gain, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("name", SEQUENCES)
def test_what_can_be_placed_is_placed_near_the_truth(box_room: BoxRoom, box_walk: Walk, name: str) -> None:
    largest_error, make = SEQUENCES[name]
    greys, poses = make(box_room, box_walk)
    truth = {i: T for i, T in enumerate(poses) if T is not None}
    found = followed(box_room, greys)
    assert sorted(found.views) == list(truth)
    assert found.errors(truth).max() < largest_error
    assert found.odometry.tracking is not None
    assert len(found.odometry.tracking.map.weak_joints) == name.startswith("a_turn_of_")
    if name != "every_frame_of_a_walk":
        return
    view, landmarks, T = found.views[50], found.odometry.tracking.map, found.pose(50)
    known = landmarks.known[view.ids]
    assert known.sum() > 150
    z = landmarks.xyz[view.ids[known]] @ T[2, :3] + T[2, 3]
    ratio = z / box_room.depth(poses[50], view.pixels[known])
    assert np.median(np.abs(ratio / np.median(ratio) - 1)) < 0.01
    assert followed(box_room, greys[:35]).poses == followed(box_room, greys[:35]).poses


@pytest.mark.parametrize("of", ["turns", "black", "grey"])
def test_pictures_without_parallax_or_texture_make_no_map(box_room: BoxRoom, of: str) -> None:
    eye = np.array([-1.2, -1.2, 1.3])
    turns = [look_at(eye, np.array([x, 3.0, 1.0])) for x in np.linspace(-1.5, 0.5, 20)]
    greys = {"turns": [box_room.grey(T) for T in turns], "black": [BLACK] * 6, "grey": [BLACK + 90] * 6}[of]
    found = followed(box_room, greys)
    assert found.odometry.tracking is None and not found.views


def test_a_map_begun_after_a_cut_is_joined_when_it_shows_the_first_ones_place(box_room, box_walk):
    """It begins beside what the first one shows, and ends there."""
    there = turning_walk(60)
    poses = [*there[:20], *[None] * 8, *box_walk.poses[:30], *there[:29:-1]]
    found = followed(box_room, [BLACK if T is None else box_room.grey(T) for T in poses], begins_anew_after=5)
    truth = {i: T for i, T in enumerate(poses) if T is not None}
    assert found.odometry.joined == 1 and not found.odometry.waiting
    assert sorted(found.views) == sorted(truth)
    assert found.errors(truth).max() < 0.03
    late = max(len(each) for each in found.brought[10:])
    assert late >= 10, "the frames of the second map come when it is joined"


def test_a_join_that_the_map_contradicts_leaves_both_maps_as_they_are(box_room, box_walk, monkeypatch):
    """The second map, which has the larger part of the frames, is of another place."""
    tried = []

    def wrong(_, active, others):
        if not others or len(active.map.keyframes) < 5 or tried:
            return None
        of, pairs = others[0].map.keyframes[0], np.c_[np.arange(40), np.arange(40)]
        tried[:] = [Recognition(of, by, pairs, np.eye(4), of.T_camera_world, 1.0) for by in active.map.keyframes[-3:]]
        return others[0], list(tried)

    other = box_room.mirrored()
    greys = [*box_walk.grey[:30], *[BLACK] * 8, *(other.grey(T) for T in box_walk.poses[:32])]
    plain = followed(box_room, greys, begins_anew_after=5)
    assert sorted(plain.views) == list(range(30)) and plain.odometry.waiting == [list(range(38, 70))]
    assert (plain.odometry.joined, plain.odometry.undone) == (0, 0)
    monkeypatch.setattr(MapJoining, "found", wrong)
    contradicted = followed(box_room, greys, begins_anew_after=5)
    assert tried and (contradicted.odometry.joined, contradicted.odometry.undone) == (0, 1)
    assert (contradicted.poses, contradicted.odometry.waiting) == (plain.poses, plain.odometry.waiting)


def test_the_largest_map_is_the_runs_if_the_first_is_lost_at_its_start(box_room, box_walk):
    other = [np.ascontiguousarray(grey[::-1]) for grey in box_walk.grey[:9]]
    found = followed(box_room, [*other, *[BLACK] * 8, *box_walk.grey[:40]], begins_anew_after=5)
    assert sorted(found.views) == list(range(17, 57))
    assert found.odometry.waiting == [list(range(9))]


def test_only_the_first_frames_of_a_recording_wait_and_not_those_of_a_camera(box_room, box_walk):
    """Both know their first map at the same frame. A recording has yet to see that it is no bad start."""
    first = {}
    for waits in (False, True):
        found = followed(box_room, box_walk.grey[:40], begins_anew_after=5, waits=waits)
        first[waits] = next(n for n, numbers in enumerate(found.brought) if numbers)
        assert list(found.views) == list(range(40))
    assert first[False] + 5 <= first[True] < 40

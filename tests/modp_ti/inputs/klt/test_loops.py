"""Loops: what a recognised place corrects, and what must not be corrected."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3, inverse_se3, moved_pose, scale_of
from modp_ti.inputs.klt.loop_closing import LoopClosing, closed_loop
from modp_ti.inputs.klt.odometry import Odometry
from modp_ti.inputs.klt.recognition import Recognition
from modp_ti.outputs.evaluation import absolute_trajectory_error
from tests.modp_ti.inputs.klt.conftest import followed
from tests.room import look_at

pytest.importorskip("gtsam", reason="loops are closed where gtsam has a wheel")


def round_walk(frames: int, turns: float) -> list[NDArray[np.float64]]:
    """T_camera_world of a camera on a circle that looks outwards."""
    angle = np.linspace(0, 2 * np.pi * turns, frames)
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros(frames)], axis=1)
    eyes = np.array([0.0, 0.4, 1.3]) + 0.9 * out
    return [look_at(eye, eye + way - np.array([0.0, 0.0, 0.05])) for eye, way in zip(eyes, out, strict=True)]


def drifting(poses: list[NDArray[np.float64]], turn: float, scale: float) -> list[NDArray[np.float64]]:
    """S_after_before (4, 4) of the world around each pose if every step turned and grew a little too much."""
    drift = exp_se3([0, 0, 0, 0, turn, 0]) @ np.diag([scale, scale, scale, 1.0])
    camera, moves = inverse_se3(poses[0]), [np.eye(4)]
    for before, after in pairwise(poses):
        camera = camera @ before @ inverse_se3(after) @ drift
        moves.append(camera @ after)
    return moves


def test_a_pose_graph_takes_the_drift_of_direction_and_scale_out_of_a_loop():
    truth = round_walk(60, 1.0)
    moves = drifting(truth, 0.002, 1.02 ** (1 / 60))
    drifted = [moved_pose(S, T) for S, T in zip(moves, truth, strict=True)]
    link = 0, 59, truth[0] @ inverse_se3(truth[59]) @ np.diag([1 / 1.02] * 3 + [1.0])
    found = closed_loop(drifted, [(i, i + 1) for i in range(59)], [link] * 3, 3.0)
    closed = [moved_pose(S, T) for S, T in zip(found, drifted, strict=True)]
    assert absolute_trajectory_error(closed, truth) < 0.2 * absolute_trajectory_error(drifted, truth)
    np.testing.assert_allclose(closed[0], drifted[0], atol=1e-6)


def bend(number: int, odometry: Odometry) -> None:
    """Give the map drift after frame 80."""
    if number != 80:
        return
    tracking = odometry.tracking
    assert tracking is not None and tracking._last is not None
    poses, last = [keyframe.T_camera_world for keyframe in tracking.map.keyframes], tracking._last
    moves = drifting(poses, 0.12 / len(poses), 1.06 ** (1 / len(poses)))
    if last.T_camera_world is not poses[-1]:  # the last frame goes with its keyframe
        last.T_camera_world = moved_pose(moves[-1], last.T_camera_world)
    tracking.map.move(moves)
    tracking.motion[:3, 3] *= float(scale_of(moves[-1]))


@pytest.mark.slow
def test_a_walk_that_comes_home_with_drift_is_closed_however_long_the_thread_takes(box_room, monkeypatch):
    truth = round_walk(100, 1.12)
    greys = [box_room.grey(T) for T in truth]
    found = followed(box_room, greys, bend, begins_anew_after=10, loops=True)
    assert found.odometry.loops >= 1
    assert found.errors(dict(enumerate(truth))).max() < 0.05  # 0.3 with the drift
    searched = LoopClosing._searched

    def late(*arguments):
        time.sleep(0.1)  # some frames
        return searched(*arguments)

    monkeypatch.setattr(LoopClosing, "_searched", late)
    assert followed(box_room, greys, bend, begins_anew_after=10, loops=True).poses == found.poses


@pytest.mark.slow
def test_a_loop_that_the_map_contradicts_is_not_closed(box_room, monkeypatch):
    found = []

    def wrong(_, landmarks, since):
        if found or since == len(landmarks.keyframes):
            return []
        of, by = landmarks.keyframes[0], landmarks.keyframes[-3:]
        nothing = np.zeros((0, 2), np.int64)
        found.extend(Recognition(of, each, nothing, np.eye(4), of.T_camera_world, 1.0) for each in by)
        return found

    greys = [box_room.grey(T) for T in round_walk(50, 0.42)]
    plain = followed(box_room, greys)
    monkeypatch.setattr(LoopClosing, "_loop", wrong)
    contradicted = followed(box_room, greys, loops=True)
    assert found and (contradicted.odometry.loops, contradicted.odometry.undone) == (0, 1)
    assert contradicted.poses == plain.poses


@pytest.mark.slow
def test_opposite_walls_that_look_alike_make_no_loop(box_room):
    across = {(axis, 1): box_room.textures[axis, 0][:, ::-1] for axis in (0, 1)}
    room = replace(box_room, textures=box_room.textures | across)
    found = followed(room, [room.grey(T) for T in round_walk(80, 0.7)], begins_anew_after=10, loops=True)
    assert len(found.views) == 80
    assert (found.odometry.loops, found.odometry.undone) == (0, 0)

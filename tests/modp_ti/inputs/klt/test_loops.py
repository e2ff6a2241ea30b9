"""Loops: what a recognised place corrects, and what must not be corrected."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3, inverse_se3, moved_pose, scale_of
from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.klt.loop_closing import Link, LoopClosing, closed_loop
from modp_ti.inputs.klt.odometry import Odometry
from modp_ti.inputs.klt.recognition import Recognition, recognised
from modp_ti.inputs.klt.tracking import Tracking
from modp_ti.outputs.evaluation import umeyama
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


def error(estimate: list[NDArray[np.float64]], truth: list[NDArray[np.float64]]) -> float:
    """RMS distance of camera centres after the best similarity."""
    a, b = (np.array([inverse_se3(T)[:3, 3] for T in poses]) for poses in (estimate, truth))
    s, R, t = umeyama(a, b)
    return float(np.sqrt(((s * a @ R.T + t - b) ** 2).sum(axis=1).mean()))


def test_a_pose_graph_takes_the_drift_of_direction_and_scale_out_of_a_loop():
    truth = round_walk(60, 1.0)
    moves = drifting(truth, 0.002, 1.02 ** (1 / 60))
    drifted = [moved_pose(S, T) for S, T in zip(moves, truth, strict=True)]
    link = Link(0, 59, truth[0] @ inverse_se3(truth[59]) @ np.diag([1 / 1.02] * 3 + [1.0]))
    found = closed_loop(drifted, [(i, i + 1) for i in range(59)], [link] * 3, 3.0)
    closed = [moved_pose(S, T) for S, T in zip(found, drifted, strict=True)]
    assert error(closed, truth) < 0.2 * error(drifted, truth)
    np.testing.assert_allclose(closed[0], drifted[0], atol=1e-6)


def followed(box_room, truth: list[NDArray[np.float64]], bend_at: int | None) -> tuple[Odometry, list]:
    """Follow a walk; `bend_at` is the frame after which the map is given drift."""
    odometry, views = Odometry([Lens.pinhole(box_room.camera)], begins_anew_after=10, loops=True), {}
    for number, T in enumerate(truth):
        views |= {view.number: view for view in odometry.process(number, box_room.grey(T))}
        if number == bend_at:
            assert odometry.tracking is not None
            bend(odometry.tracking)
    assert sorted(views) == list(range(len(truth)))
    return odometry, [views[i] for i in range(len(truth))]


def bend(tracking: Tracking) -> None:
    poses = [keyframe.T_camera_world for keyframe in tracking.map.keyframes]
    moves = drifting(poses, 0.12 / len(poses), 1.06 ** (1 / len(poses)))
    last = tracking._last
    assert last is not None
    if last.T_camera_world is not poses[-1]:  # the last frame goes with its keyframe
        last.T_camera_world = moved_pose(moves[-1], last.T_camera_world)
    tracking.map.move(moves)
    tracking.motion[:3, 3] *= float(scale_of(moves[-1]))


@pytest.mark.slow
def test_a_walk_that_comes_home_with_drift_is_closed_however_long_the_thread_takes(box_room, monkeypatch):
    truth = round_walk(132, 1.15)
    odometry, views = followed(box_room, truth, 108)
    assert odometry.loops >= 1
    poses = [view.T_camera_world for view in views]
    assert error(poses, truth) < 0.02  # 0.3 with the drift
    searched = LoopClosing._searched

    def late(*arguments):
        time.sleep(0.1)  # some frames
        return searched(*arguments)

    monkeypatch.setattr(LoopClosing, "_searched", late)
    _, again = followed(box_room, truth, 108)
    assert [T.tobytes() for T in poses] == [view.T_camera_world.tobytes() for view in again]


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

    truth = round_walk(60, 0.5)
    _, views = followed(box_room, truth, None)
    monkeypatch.setattr("modp_ti.inputs.klt.loop_closing.LoopDetection.search", wrong)
    odometry, again = followed(box_room, truth, None)
    assert found and (odometry.loops, odometry.undone) == (0, 1)
    for view, other in zip(views, again, strict=True):
        np.testing.assert_array_equal(view.T_camera_world, other.T_camera_world)


@pytest.mark.slow
def test_opposite_walls_that_look_alike_make_no_loop(box_room, monkeypatch):
    across = {(axis, 1): box_room.textures[axis, 0][:, ::-1] for axis in (0, 1)}
    room = replace(box_room, textures=box_room.textures | across)
    recognitions = []

    def noted(*arguments):
        recognitions.append(recognised(*arguments))
        return recognitions[-1]

    monkeypatch.setattr("modp_ti.inputs.klt.loop_closing.recognised", noted)
    odometry, _ = followed(room, round_walk(80, 0.7), None)
    assert sum(found is not None for found in recognitions) >= 3
    assert (odometry.loops, odometry.undone) == (0, 0)

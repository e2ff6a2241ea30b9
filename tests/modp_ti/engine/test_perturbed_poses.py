"""Poses that a tracker got wrong come back while the map is made."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from modp_ti.outputs.evaluation import absolute_trajectory_error, umeyama
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from tests.room import Room, RoomRecording, pinhole, walk
from tests.simulated_tracker import noisy_poses, tracked

pytestmark = pytest.mark.slow


def rotation_error(estimate: list[NDArray], truth: list[NDArray]) -> float:
    """RMS angle [degrees] between cameras, after the one rotation of the world that fits best."""
    M = sum(G[:3, :3].T @ T[:3, :3] for T, G in zip(estimate, truth, strict=True))
    U, _, Vt = np.linalg.svd(M)
    cosines = [(np.trace(G[:3, :3] @ U @ Vt @ T[:3, :3].T) - 1) / 2 for T, G in zip(estimate, truth, strict=True)]
    return float(np.degrees(np.sqrt(np.mean(np.arccos(np.clip(cosines, -1, 1)) ** 2))))


@pytest.fixture(scope="module")
def poses(taichi_on_the_cpu: None, room: Room) -> dict[str, list[NDArray]]:
    """True, tracked and refined poses of the keyframes.

    The tracked poses have errors of half a percent of the scene's depth and half a degree per axis, independent in
    each frame.
    """
    truth = walk(14, step=0.06)
    recording = RoomRecording(room, pinhole(80, 60), truth, points=350)
    mapper = OnlineMapper(MappingSettings(optimise={"steps": 12}), 80, 60, seed=0)
    for frame in tracked(recording.frames(), noisy_poses(truth, translation=0.005, rotation=0.5, smooth=0)):
        mapper.process(frame)
    mapper.finish()
    assert len(mapper.keyframes) > 4  # 8 to 14 over twelve draws
    return {
        "true": [truth[k.index] for k in mapper.keyframes],
        "tracked": [k.T_tracked for k in mapper.keyframes],
        "refined": [k.T_camera_world for k in mapper.keyframes],
    }


def test_the_tracked_poses_are_as_wrong_as_they_were_made(poses: dict[str, list[NDArray]]) -> None:
    assert rotation_error(poses["tracked"], poses["true"]) > 0.3  # 0.64 to 0.86 over four seeds
    centres = np.array([inverse_se3(T)[:3, 3] for T in poses["tracked"]])
    truth = np.array([inverse_se3(T)[:3, 3] for T in poses["true"]])
    assert umeyama(centres, truth)[0] == pytest.approx(1.0, abs=0.1)


def test_the_error_of_rotation_shrinks(poses: dict[str, list[NDArray]]) -> None:
    before = rotation_error(poses["tracked"], poses["true"])
    assert rotation_error(poses["refined"], poses["true"]) < 0.4 * before  # 0.08 to 0.14 over four seeds


def test_the_error_of_translation_shrinks(poses: dict[str, list[NDArray]]) -> None:
    before = absolute_trajectory_error(poses["tracked"], poses["true"])
    assert absolute_trajectory_error(poses["refined"], poses["true"]) < 0.4 * before  # 0.10 to 0.20 over four seeds

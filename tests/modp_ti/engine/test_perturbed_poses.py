"""Poses that a tracker got wrong come back while the map is made."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from modp_ti.inputs.synthetic import SyntheticTracker, TrackerNoise
from modp_ti.outputs.evaluation import absolute_trajectory_error, umeyama
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings

pytestmark = pytest.mark.slow

# Half a percent of the scene's depth and half a degree an axis, another error in every frame; points lie where the
# wrong pose of the frame that saw them first puts them.
NOISE = TrackerNoise(pixel=0.3, depth=0.01, translation=0.005, rotation=0.5, drift=0.0)


def rotation_error(estimate: list[NDArray], truth: list[NDArray]) -> float:
    """RMS angle [degrees] between cameras, after the one rotation of the world that fits best."""
    M = sum(G[:3, :3].T @ T[:3, :3] for T, G in zip(estimate, truth, strict=True))
    U, _, Vt = np.linalg.svd(M)
    cosines = [(np.trace(G[:3, :3] @ U @ Vt @ T[:3, :3].T) - 1) / 2 for T, G in zip(estimate, truth, strict=True)]
    return float(np.degrees(np.sqrt(np.mean(np.arccos(np.clip(cosines, -1, 1)) ** 2))))


@pytest.fixture(scope="module")
def poses(taichi_on_the_cpu: None) -> dict[str, list[NDArray]]:
    """True, tracked and refined poses of the keyframes."""
    tracker = SyntheticTracker(width=160, height=120, frames=56, select=slice(0, 28), noise=NOISE)
    mapper = OnlineMapper(MappingSettings(), 160, 120, seed=0)
    for frame in tracker:
        mapper.process(frame)
    mapper.finish()
    truth = tracker.ground_truth()
    assert len(mapper.keyframes) > 10
    return {
        "true": [truth[k.index] for k in mapper.keyframes],
        "tracked": [k.T_tracked for k in mapper.keyframes],
        "refined": [k.T_camera_world for k in mapper.keyframes],
    }


def test_the_tracked_poses_are_as_wrong_as_they_were_made(poses: dict[str, list[NDArray]]) -> None:
    assert rotation_error(poses["tracked"], poses["true"]) > 0.5
    centres = np.array([inverse_se3(T)[:3, 3] for T in poses["tracked"]])
    truth = np.array([inverse_se3(T)[:3, 3] for T in poses["true"]])
    assert umeyama(centres, truth)[0] == pytest.approx(1.0, abs=0.1)


def test_the_error_of_rotation_shrinks(poses: dict[str, list[NDArray]]) -> None:
    before = rotation_error(poses["tracked"], poses["true"])
    assert rotation_error(poses["refined"], poses["true"]) < 0.8 * before  # 0.51 in a draw


def test_the_error_of_translation_shrinks(poses: dict[str, list[NDArray]]) -> None:
    before = absolute_trajectory_error(poses["tracked"], poses["true"])
    assert absolute_trajectory_error(poses["refined"], poses["true"]) < 0.8 * before  # 0.61 in a draw

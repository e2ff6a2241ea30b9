from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modp_ti.outputs.evaluation import FrameScore, absolute_trajectory_error, summary, umeyama


def test_the_summary_holds_means_and_nothing_where_there_are_no_frames() -> None:
    assert summary([]) == {"psnr": None, "ssim": None, "lpips": None, "detail": None, "count": 0}
    scores = [FrameScore(0, "a", True, "online", 20.0, 0.5, None), FrameScore(1, "b", False, "online", 30.0, 0.7, None)]
    assert summary(scores) == {"psnr": 25.0, "ssim": 0.6, "lpips": None, "detail": None, "count": 2}
    scores = [replace(score, lpips=0.1 + 0.2 * score.index) for score in scores]
    assert summary(scores)["lpips"] == 0.2


@pytest.mark.parametrize("with_scale", [True, False])
def test_a_known_similarity_is_found(with_scale: bool) -> None:
    rng = np.random.default_rng(1)
    source = rng.normal(size=(20, 3))
    R = Rotation.random(random_state=2).as_matrix()
    s = 3.5 if with_scale else 1.0
    found_s, found_R, found_t = umeyama(source, s * source @ R.T + [1.0, -2.0, 3.0], with_scale)
    assert found_s == pytest.approx(s)
    np.testing.assert_allclose(found_R, R, atol=1e-12)
    np.testing.assert_allclose(found_t, [1.0, -2.0, 3.0], atol=1e-12)


def test_a_mirrored_cloud_is_answered_by_a_rotation() -> None:
    source = np.random.default_rng(3).normal(size=(20, 3))
    assert np.linalg.det(umeyama(source, source * [-1.0, 1.0, 1.0])[1]) == pytest.approx(1.0)


def poses(centres: np.ndarray) -> list[np.ndarray]:
    result = []
    for i, centre in enumerate(centres):
        T = np.eye(4)
        T[:3, :3] = Rotation.random(random_state=i).as_matrix()
        T[:3, 3] = -T[:3, :3] @ centre
        result.append(T)
    return result


def test_the_trajectory_error_is_that_of_the_centres_after_alignment() -> None:
    rng = np.random.default_rng(4)
    centres = rng.normal(size=(40, 3))
    noise = rng.normal(scale=0.01, size=(40, 3))
    turned = 0.2 * (centres + noise) @ Rotation.random(random_state=9).as_matrix() + [4.0, 5.0, 6.0]
    error = absolute_trajectory_error(poses(turned), poses(centres))
    # Alignment can only take away from the plain error, and seven numbers take little from 120.
    plain = np.sqrt((noise**2).sum(axis=1).mean())
    assert 0.9 * plain < error <= plain


def test_scale_is_an_error_where_it_must_not_be_aligned() -> None:
    centres = np.random.default_rng(5).normal(size=(10, 3))
    assert absolute_trajectory_error(poses(2 * centres), poses(centres)) == pytest.approx(0.0, abs=1e-12)
    assert absolute_trajectory_error(poses(2 * centres), poses(centres), with_scale=False) > 0.5

from __future__ import annotations

import numpy as np
import pytest

from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.densify.depth import DepthEstimate, FusedDepth
from tests.pipelines.wall import frame


class Says:
    """An estimator of fixed answers."""

    def __init__(self, depth: list[float], deviation: list[float]) -> None:
        self.answer = DepthEstimate(np.array(depth), np.array(deviation))

    def estimate(self, view: Keyframe, neighbours: object, pixels: np.ndarray) -> DepthEstimate:
        return self.answer


def fuse(*estimators: Says) -> DepthEstimate:
    view = KeyframeStore().append(frame(0))
    return FusedDepth(estimators).estimate(view, [], np.zeros((len(estimators[0].answer.depth), 2)))


def test_estimates_that_agree_are_weighted_by_their_inverse_variance() -> None:
    fused = fuse(Says([2.0], [0.03]), Says([2.02], [0.01]))
    a, b = 1 / 0.03**2, 1 / 0.01**2
    assert np.log(fused.depth[0]) == pytest.approx((a * np.log(2.0) + b * np.log(2.02)) / (a + b))
    assert fused.deviation[0] == pytest.approx((a + b) ** -0.5)


def test_an_estimator_that_knows_nothing_is_not_heard() -> None:
    fused = fuse(Says([2.0, 1.0, 1.0], [0.03, np.inf, np.inf]), Says([9.0, 3.0, 1.0], [np.inf, 0.02, np.inf]))
    np.testing.assert_allclose(fused.depth[:2], [2.0, 3.0])
    np.testing.assert_allclose(fused.deviation, [0.03, 0.02, np.inf])


def test_contradiction_leaves_a_pixel_uncertain() -> None:
    fused = fuse(Says([2.0], [0.02]), Says([3.0], [0.02]))
    # Two equal weights at distance d: the standard error of their mean is d / 2.
    assert fused.deviation[0] == pytest.approx(np.log(1.5) / 2)

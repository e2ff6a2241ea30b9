from __future__ import annotations

import numpy as np
import pytest

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.keyframes import KeyframeStore
from pipelines.select.views import LocalGlobalViews, global_probabilities
from pipelines.settings import ViewSettings

CAMERA = PinholeCamera(10.0, 10.0, 10.0, 10.0, 20, 20)


def store(errors: list[float], far: tuple[int, ...] = ()) -> KeyframeStore:
    """Keyframes side by side; those in `far` look at another place."""
    result = KeyframeStore()
    for index, error in enumerate(errors):
        T = np.eye(4)
        T[0, 3] = 1000.0 if index in far else -0.01 * index
        xyz = np.array([[0.0, 0.0, 2.0], [0.5, 0.5, 2.0]]) - T[:3, 3]
        points = SparsePoints(xyz, np.full((2, 2), 10.0), np.arange(2))
        image = np.zeros((20, 20, 3), dtype=np.float32)
        result.append(TrackedFrame(index, 0.0, str(index), image, CAMERA, T, points)).error = error
    return result


def test_global_probabilities_are_equation_2() -> None:
    errors = [0.01, 0.05, 0.02]
    weights = [np.exp(50 * e) * np.exp(0.3 * (j - 2)) for j, e in enumerate(errors)]
    p = global_probabilities(store(errors), 50.0, 0.3, np.arange(3))
    np.testing.assert_allclose(p, np.array(weights) / sum(weights))
    p = global_probabilities(store(errors), 50.0, 0.3, np.array([0, 2]))
    np.testing.assert_allclose(p, np.array(weights)[[0, 2]] / (weights[0] + weights[2]))


def test_global_probabilities_stand_errors_of_any_size() -> None:
    p = global_probabilities(store([0.0, 100.0]), 50.0, 0.001, np.arange(2))
    assert p[1] == pytest.approx(1.0)


def test_a_step_looks_at_one_current_one_local_and_four_global_views() -> None:
    views = LocalGlobalViews(ViewSettings(local_views=1, global_views=4), np.random.default_rng(0))
    keyframes = store([0.1] * 30)
    views.begin(keyframes)
    draws = np.array([views.select(keyframes) for _ in range(300)])
    assert draws.shape == (300, 6)
    assert (draws[:, 0] == 29).all()
    assert set(draws[:, 1]) == set(range(19, 29))  # the ten before the current one
    assert len(set(draws[:, 2:].ravel())) == 30


def test_global_views_follow_their_probabilities() -> None:
    settings = ViewSettings(local_views=0, global_views=1)
    views = LocalGlobalViews(settings, np.random.default_rng(1))
    keyframes = store([0.00, 0.02, 0.04])
    views.begin(keyframes)
    drawn = np.bincount([views.select(keyframes)[1] for _ in range(4000)], minlength=3) / 4000
    expected = global_probabilities(keyframes, settings.error_weight, 0.001, np.arange(3))
    np.testing.assert_allclose(drawn, expected, atol=0.03)


def test_local_views_are_drawn_by_covisibility() -> None:
    views = LocalGlobalViews(ViewSettings(local_views=1, global_views=0), np.random.default_rng(2))
    keyframes = store([0.1] * 4, far=(0, 1))
    views.begin(keyframes)
    assert {views.select(keyframes)[1] for _ in range(100)} == {2}


def test_keyframes_that_see_much_of_what_lies_on_disk_are_not_drawn() -> None:
    views = LocalGlobalViews(ViewSettings(local_views=2, global_views=3), np.random.default_rng(4))
    keyframes = store([0.1] * 6)
    keyframes.most_missing = 1
    for place, missing in enumerate([2, 0, 1, 2, 0, 3]):
        keyframes[place].missing = missing
    views.begin(keyframes)
    draws = np.array([views.select(keyframes) for _ in range(100)])
    assert (draws[:, 0] == 5).all()
    assert set(draws[:, 1:].ravel()) == {1, 2, 4}


def test_the_first_keyframe_is_alone() -> None:
    views = LocalGlobalViews(ViewSettings(), np.random.default_rng(3))
    keyframes = store([1.0])
    views.begin(keyframes)
    assert views.select(keyframes) == [0]


def test_the_same_seed_draws_the_same_views() -> None:
    keyframes = store([0.1] * 12)
    draws = []
    for _ in range(2):
        views = LocalGlobalViews(ViewSettings(), np.random.default_rng(4))
        views.begin(keyframes)
        draws.append([views.select(keyframes) for _ in range(20)])
    assert draws[0] == draws[1]


def test_a_frame_after_the_latest_keyframe_is_a_global_view_only() -> None:
    keyframes = store([0.1] * 4)
    T, image = np.eye(4), np.zeros((20, 20, 3), dtype=np.float32)
    keyframes.append(TrackedFrame(9, 0.3, "9", image, CAMERA, T, keyframes[0].points), is_between=True)
    views = LocalGlobalViews(ViewSettings(local_views=1, global_views=2), np.random.default_rng(3))
    views.begin(keyframes)
    draws = np.array([views.select(keyframes) for _ in range(100)])
    assert (draws[:, 0] == 3).all() and set(draws[:, 1]) == {0, 1, 2} and set(draws[:, 2:].ravel()) == set(range(5))

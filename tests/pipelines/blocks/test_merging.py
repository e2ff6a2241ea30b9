"""Merged Gaussians, against moments that plain float64 loops compute."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.whole.hierarchy import MOST_OPAQUE, merged


def some(count: int, opacity: float = -3.0) -> dict[str, NDArray[np.float32]]:
    """Small Gaussians in the cube from -2 to 2."""
    rng = np.random.default_rng(7)
    state = {
        "position": rng.uniform(-2.0, 2.0, (count, 3)),
        "log_scale": rng.normal(-3.5, 0.3, (count, 3)),
        "quaternion": rng.normal(0.0, 1.0, (count, 4)),
        "opacity_logit": rng.normal(opacity, 0.5, count),
        "sh": rng.normal(0.0, 1.0, (count, 4, 3)),
    }
    return {name: values.astype(np.float32) for name, values in state.items()}


def covariance(state: dict[str, NDArray], i: int) -> NDArray[np.float64]:
    R = Rotation.from_quat(state["quaternion"][i].astype(np.float64), scalar_first=True).as_matrix()
    return R @ np.diag(np.exp(2.0 * state["log_scale"][i].astype(np.float64))) @ R.T


def mean_square_area(S: NDArray[np.float64]) -> float:
    """Mean square of the area of an ellipsoid's outline over directions, up to a constant: from its axes."""
    a, b, c = np.sqrt(np.linalg.eigvalsh(S))
    return float((a * b) ** 2 + (b * c) ** 2 + (a * c) ** 2)


def weight(state: dict[str, NDArray], i: int) -> float:
    return mean_square_area(covariance(state, i)) ** 0.5 / (1.0 + np.exp(-float(state["opacity_logit"][i])))


def cells(state: dict[str, NDArray], group: NDArray, side: float) -> dict[tuple, list[int]]:
    found: dict[tuple, list[int]] = {}
    for i, position in enumerate(state["position"].astype(np.float64)):
        found.setdefault((int(group[i]), *(int(np.floor(x / side)) for x in position)), []).append(i)
    return found


def test_a_merged_gaussian_has_the_moments_of_its_cell() -> None:
    state, group = some(300), np.arange(300) // 150
    few, of_group = merged(state, group, 2.0)
    expected = cells(state, group, 2.0)
    assert len(expected) == 16 and of_group.tolist() == sorted(key[0] for key in expected)
    for k, key in enumerate(sorted(expected)):
        w = np.array([weight(state, i) for i in expected[key]])
        mean = sum(a * state["position"][i].astype(np.float64) for a, i in zip(w, expected[key], strict=True)) / w.sum()
        S = np.zeros((3, 3))
        for a, i in zip(w, expected[key], strict=True):
            offset = state["position"][i].astype(np.float64) - mean
            S += a / w.sum() * (covariance(state, i) + np.outer(offset, offset))
        np.testing.assert_allclose(few["position"][k], mean, atol=1e-6)
        np.testing.assert_allclose(covariance(few, k), S, atol=1e-5 * np.trace(S))
        sh = np.einsum("n,nkc->kc", w / w.sum(), state["sh"][expected[key]].astype(np.float64))
        np.testing.assert_allclose(few["sh"][k], sh, atol=1e-5)
        # The total of opacity times area is kept.
        assert weight(few, k) == pytest.approx(w.sum(), rel=1e-4)


def test_an_opacity_stays_below_one() -> None:
    state = some(20000, opacity=6.0)
    few, _ = merged(state, np.zeros(20000, dtype=np.int64), 2.0)
    assert len(few["position"]) == 8
    np.testing.assert_allclose(1.0 / (1.0 + np.exp(-few["opacity_logit"])), MOST_OPAQUE, rtol=1e-5)


def test_gaussians_that_are_alone_or_large_stay_as_they_are() -> None:
    state = some(40)
    state["log_scale"][7, 1] = 0.5
    order = np.argsort(state["position"][:, 0], kind="stable")
    alone, group = merged(state, np.argsort(order), 1e6)  # each in a group of its own
    assert group.tolist() == list(range(40))
    for name, values in state.items():
        np.testing.assert_array_equal(alone[name], values[order])
    some_of_them, _ = merged(state, np.zeros(40, dtype=np.int64), 2.0)
    kept = (some_of_them["position"] == state["position"][7]).all(axis=1)
    assert kept.sum() == 1
    for name, values in state.items():
        np.testing.assert_array_equal(some_of_them[name][kept][0], values[7])


def test_no_gaussians_are_merged_to_none() -> None:
    none, group = merged({name: values[:0] for name, values in some(3).items()}, np.zeros(0, dtype=np.int64), 1.0)
    assert len(group) == 0 and none["sh"].shape == (0, 4, 3)

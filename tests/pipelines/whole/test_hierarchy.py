"""Levels of detail: groups of keyframes, merged Gaussians with the moments of their parts, and what is shown."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fields.geometry.se3 import exp_se3
from fields.map.gaussians import GaussianField
from fields.runtime.backend import initialise
from pipelines.companions.paging import grouped
from pipelines.render.renderer import Renderer
from pipelines.whole.hierarchy import MOST_OPAQUE, Hierarchy, ShownMap, merged
from tests.pipelines.wall import CAMERA


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


FOCAL = 300.0


@pytest.fixture(scope="module")
def street() -> Hierarchy:
    """20,000 Gaussians along 80 units of a street."""
    state = some(20_000)
    state["position"][:, 2] = 20.0 * state["position"][:, 2] + 40.0
    return Hierarchy(state)


def test_a_map_that_fits_is_drawn_as_it_is(street: Hierarchy) -> None:
    blocks = np.arange(len(street.blocks))
    assert (street.levels_for(blocks, np.zeros(3), FOCAL, 20_000) == 0).all()
    drawn = street.gaussians(blocks, np.zeros(len(blocks), dtype=np.int64))
    for name, values in street.level(0).values.items():
        np.testing.assert_array_equal(drawn[name], values[street.blocks.members])


@pytest.mark.parametrize("most", [15_000, 8_000, 3_000])
def test_far_blocks_lose_detail_first_until_all_fit(street: Hierarchy, most: int) -> None:
    blocks = np.arange(len(street.blocks))
    levels = street.levels_for(blocks, np.zeros(3), FOCAL, most)
    assert levels.min() >= 0
    drawn = street.gaussians(blocks, levels)
    assert 0.5 * most < len(drawn["position"]) <= most
    distance = street.blocks.boxes.distance(np.zeros(3))
    assert (np.diff(levels[np.argsort(distance)]) >= 0).all()
    # Every block is there: its Gaussians lie in its box.
    for block, level in zip(blocks, levels, strict=True):
        there = street.gaussians(np.array([block]), np.array([level]))["position"]
        box = street.blocks.boxes[np.array([block])]
        assert len(there) and (there >= box.low - 1e-5).all() and (there <= box.high + 1e-5).all()


def test_a_group_ends_before_it_would_see_more_than_fits() -> None:
    seen = np.array([[1, 1, 0, 0, 0], [0, 1, 1, 0, 0], [0, 0, 1, 1, 0], [0, 0, 0, 1, 1], [0, 0, 0, 0, 1]], dtype=bool)
    counts = np.array([10, 20, 30, 40, 50])
    for room in (60, 90, 100, 150, 1000):
        group = grouped(seen, counts, room)
        assert group[0] == 0 and set(np.diff(group)) <= {0, 1}
        for number in range(group[-1] + 1):
            together = counts[seen[group == number].any(axis=0)].sum()
            assert together <= room or (group == number).sum() == 1
            if number < group[-1]:  # one more would not have fitted
                following = np.flatnonzero(group == number)[-1] + 1
                assert counts[seen[group == number].any(axis=0) | seen[following]].sum() > room


def test_a_group_ends_before_another_place_that_does_not_fit_whole() -> None:
    """Keyframes 0 to 2 see one place, 3 to 6 another; the last one does not fit beside the first place."""
    seen = np.zeros((7, 8), dtype=bool)
    seen[[0, 1, 2], [0, 1, 2]] = seen[[0, 1, 2], [1, 2, 3]] = True
    seen[[3, 4, 5, 6], [4, 5, 6, 7]] = seen[3:, 4] = True
    counts = np.full(8, 10)
    assert grouped(seen, counts, 70).tolist() == [0, 0, 0, 1, 1, 1, 1]
    seen[3:, 3] = True  # a block of both: a fifth of what the later keyframes of the group see
    assert grouped(seen, counts, 70).tolist() == [0, 0, 0, 0, 0, 0, 1]
    counts[3] = 1  # now hardly any
    assert grouped(seen, counts, 65).tolist() == [0, 0, 0, 1, 1, 1, 1]


@pytest.fixture(scope="module")
def values(taichi_on_the_cpu: None) -> dict[str, np.ndarray]:
    """3,000 Gaussians in a ball around the cameras."""
    rng = np.random.default_rng(3)
    direction = rng.normal(0.0, 1.0, (3000, 3))
    return {
        "position": direction / np.linalg.norm(direction, axis=1)[:, None] * rng.uniform(2.0, 4.0, (3000, 1)),
        "log_scale": rng.normal(-2.5, 0.4, (3000, 3)),
        "quaternion": rng.normal(0.0, 1.0, (3000, 4)),
        "opacity_logit": rng.normal(0.0, 1.0, 3000),
        "sh": rng.normal(0.0, 1.0, (3000, 1, 3)),
    }


def renders(capacity: int, values: dict[str, np.ndarray]) -> tuple[list[np.ndarray], list[int]]:
    """Pictures in several directions, and the number of Gaussians that were loaded for each."""
    initialise("cpu")
    field = GaussianField(0, capacity)
    renderer, shown = Renderer(field, CAMERA.width, CAMERA.height), ShownMap(field, values)
    pictures, loaded = [], []
    for i in range(4):
        T = exp_se3([0.1 * i, 0.0, 0.0, 0.3, 1.5 * i, 0.0])
        shown.show(CAMERA, T)
        pictures.append(renderer.render(CAMERA, T, 0.01).colour)
        loaded.append(len(field))
    return pictures, loaded


def test_a_map_that_does_not_fit_looks_as_one_that_does(values: dict[str, np.ndarray]) -> None:
    whole, all_of_it = renders(4096, values)
    parts, some_of_it = renders(2048, values)
    assert all_of_it == [3000] * 4 and max(some_of_it) <= 2048 and min(some_of_it) > 0
    for one, other in zip(parts, whole, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_from_afar_merged_gaussians_look_as_the_whole_map(values: dict[str, np.ndarray]) -> None:
    initialise("cpu")
    few, many = GaussianField(0, 1024), GaussianField(0, 4096)
    T = exp_se3([0.0, 0.0, 30.0, 0.0, 0.0, 0.0])
    pictures, renderers = [], {}
    for field in (many, few):
        ShownMap(field, values).show(CAMERA, T)
        renderers[field] = Renderer(field, CAMERA.width, CAMERA.height)
        pictures.append(renderers[field].render(CAMERA, T, 0.01).colour)
    assert len(many) == 3000 and 300 < len(few) <= 1024
    whole, merged = (np.clip(picture, 0.0, 1.0) for picture in pictures)
    shown = whole.max(axis=2) > 0.02
    # A third of the Gaussians, chosen at random, are what it has to be better than.
    third = np.random.default_rng(0).permutation(3000)[: len(few)]
    many.load({name: array[third] for name, array in values.items()})
    chosen = np.clip(renderers[many].render(CAMERA, T, 0.01).colour, 0.0, 1.0)
    errors = [float(np.mean((picture - whole)[shown] ** 2)) for picture in (merged, chosen)]
    assert 4.0 * errors[0] < errors[1]

"""The pool of Gaussians: appending, removing, growing without a new compilation, and saving and loading."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.map.gaussians import NO_ANCHOR, GaussianField


@pytest.fixture(scope="module")
def shared(taichi_on_the_cpu: None) -> GaussianField:
    return GaussianField(1, max_gaussians=1 << 19)


@pytest.fixture
def gaussians(shared: GaussianField) -> GaussianField:
    """An empty pool."""
    shared.remove(np.zeros(len(shared), dtype=bool))
    return shared


def state(n: int, seed: int = 0) -> dict[str, NDArray[np.float32]]:
    rng = np.random.default_rng(seed)
    shapes = {"position": (3,), "log_scale": (3,), "quaternion": (4,), "opacity_logit": (), "sh": (4, 3)}
    return {name: rng.normal(size=(n, *shape)).astype(np.float32) for name, shape in shapes.items()}


def assert_equal(a: dict[str, NDArray], b: dict[str, NDArray]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name])


def test_what_is_appended_is_read_back(gaussians: GaussianField) -> None:
    first, second = state(5, 1), state(3000, 2)
    gaussians.append(**first)
    gaussians.append(**second)
    assert len(gaussians) == 3005
    assert_equal(gaussians.to_numpy(), {name: np.concatenate([first[name], second[name]]) for name in first})


@pytest.mark.parametrize("seed", range(4))
def test_survivors_keep_values_and_history(gaussians: GaussianField, seed: int) -> None:
    n = 2500
    gaussians.append(**state(n, seed))
    # A history that tells the Gaussians apart.
    fields = [gaussians.position_m, gaussians.log_scale_v, gaussians.quaternion_m]
    for field in fields:
        values = field.to_numpy()
        values[:n] = np.arange(n)[:, None]
        field.from_numpy(values)
    steps = gaussians.steps.to_numpy()
    steps[:n] = np.arange(n)
    gaussians.steps.from_numpy(steps)
    before = gaussians.to_numpy()
    keep = np.random.default_rng(seed).random(n) < 0.1 + 0.25 * seed
    assert gaussians.remove(keep) == n - keep.sum()
    assert len(gaussians) == keep.sum()
    order = gaussians.steps.to_numpy()[: len(gaussians)]
    assert sorted(order) == np.flatnonzero(keep).tolist()
    assert_equal(gaussians.to_numpy(), {name: value[order] for name, value in before.items()})
    for field in fields:
        np.testing.assert_array_equal(field.to_numpy()[: len(gaussians), 0], order)


def test_a_gaussian_in_a_place_that_was_freed_has_no_history(gaussians: GaussianField) -> None:
    gaussians.append(**state(10))
    for field in (gaussians.position_m, gaussians.sh_v, gaussians.steps, gaussians.position.grad):
        field.fill(1)
    gaussians.remove(np.zeros(10, dtype=bool))
    gaussians.append(**state(10, 1))
    for field in (gaussians.position_m, gaussians.sh_v, gaussians.steps, gaussians.position.grad):
        assert (field.to_numpy()[:10] == 0).all()


def test_anchors_stay_with_their_gaussians_through_growth_and_removal(gaussians: GaussianField) -> None:
    for anchor in (7, 3, 0):
        gaussians.append(**state(900, anchor), anchor=anchor)
    gaussians.append(**state(10, 9))
    # The first coefficient tells which Gaussian it is.
    owner = dict(zip(gaussians.to_numpy()["sh"][:, 0, 0].tolist(), gaussians.anchors().tolist(), strict=True))
    assert gaussians.anchors().tolist() == [7] * 900 + [3] * 900 + [0] * 900 + [NO_ANCHOR] * 10
    gaussians.remove(np.random.default_rng(0).random(len(gaussians)) < 0.4)
    gaussians.append(**state(50, 11), anchor=12)
    kept = gaussians.to_numpy()["sh"][:-50, 0, 0].tolist()
    assert gaussians.anchors().tolist() == [owner[value] for value in kept] + [12] * 50
    gaussians.load(gaussians.to_numpy())
    assert (gaussians.anchors() == NO_ANCHOR).all()


@pytest.mark.parametrize("name", ["position", "log_scale", "quaternion", "opacity_logit", "sh"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_is_refused_with_its_index(gaussians: GaussianField, name: str, value: float) -> None:
    bad = state(6)
    bad[name][3] = value
    with pytest.raises(ValueError, match=f"Gaussian 3: {name}"):
        gaussians.load(bad)


def test_shapes_that_disagree_and_a_full_pool_are_refused(gaussians: GaussianField) -> None:
    bad = state(6)
    bad["log_scale"] = bad["log_scale"][:5]
    with pytest.raises(ValueError, match="log_scale"):
        gaussians.append(**bad)
    with pytest.raises(ValueError, match="max_gaussians"):
        gaussians.append(**state(524289))


def test_a_refused_state_leaves_the_content(gaussians: GaussianField) -> None:
    gaussians.append(**state(5))
    before = gaussians.to_numpy()
    bad = state(9, 1)
    bad["quaternion"][2] = 0
    with pytest.raises(ValueError, match="Gaussian 2"):
        gaussians.load(bad)
    assert_equal(gaussians.to_numpy(), before)

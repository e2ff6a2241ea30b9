"""The pool of Gaussians, and how they follow the cameras that they were placed in."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fields.map.gaussian_motion import GaussianMotion
from fields.map.gaussians import NO_ANCHOR, GaussianField
from pipelines.render.spherical_harmonics import sh_rotation
from tests.pipelines.reference import sh_basis


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


DEGREE, K = 3, 16

MOMENTS = ("position", "log_scale", "quaternion", "opacity_logit", "sh")


@pytest.fixture(scope="module")
def motion(taichi_on_the_cpu: None) -> GaussianMotion:
    return GaussianMotion(GaussianField(DEGREE, max_gaussians=1024))


def similarity(seed: int, scale: float) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    S = np.eye(4)
    S[:3, :3] = scale * Rotation.random(rng=rng).as_matrix()
    S[:3, 3] = rng.normal(size=3)
    return S


# Of anchors 0 to 3; the second stays.
S = np.stack([similarity(1, 1.3), np.eye(4), similarity(2, 0.7), similarity(3, 1.0)])

TURN = [M[:3, :3] / np.cbrt(np.linalg.det(M[:3, :3])) for M in S]

SH_TURN = np.stack([sh_rotation(DEGREE, R) for R in TURN])


def moments(gaussians: GaussianField) -> dict[str, NDArray]:
    fields = {f"{name}_{which}": getattr(gaussians, f"{name}_{which}") for name in MOMENTS for which in "mv"}
    return {name: field.to_numpy()[: len(gaussians)] for name, field in fields.items()}


@pytest.fixture
def states(motion: GaussianMotion) -> tuple[dict[str, NDArray], dict[str, NDArray], NDArray[np.int32]]:
    """Values and moments before and after the move, and the anchors: -1, 0, 1, 2, 3, ten Gaussians each."""
    gaussians, rng = motion.gaussians, np.random.default_rng(0)
    gaussians.remove(np.zeros(len(gaussians), dtype=bool))
    shapes = {"position": (3,), "log_scale": (3,), "quaternion": (4,), "opacity_logit": (), "sh": (K, 3)}
    for anchor in range(-1, 4):
        gaussians.append(**{name: rng.normal(size=(10, *s)) for name, s in shapes.items()}, anchor=anchor)
    for name in MOMENTS:
        for which in "mv":
            field = getattr(gaussians, f"{name}_{which}")
            values = field.to_numpy()
            field.from_numpy((rng.normal(size=values.shape) ** (1 if which == "m" else 2)).astype(np.float32))
    before = gaussians.to_numpy() | moments(gaussians)
    motion.move(S, SH_TURN)
    return before, gaussians.to_numpy() | moments(gaussians), gaussians.anchors()


def test_gaussians_without_a_motion_keep_every_bit(states) -> None:
    before, after, anchors = states
    stays = (anchors == -1) | (anchors == 1)
    assert np.count_nonzero(stays) == 20
    for name in before:
        np.testing.assert_array_equal(after[name][stays], before[name][stays])


@pytest.mark.parametrize("anchor", [0, 2, 3])
def test_place_and_shape_are_those_of_the_moved_ellipsoid(states, anchor: int) -> None:
    before, after, anchors = states
    mine = anchors == anchor
    linear, shift = S[anchor, :3, :3], S[anchor, :3, 3]

    def covariance(state: dict[str, NDArray]) -> NDArray:
        q = state["quaternion"][mine].astype(np.float64)
        A = Rotation.from_quat(q, scalar_first=True).as_matrix() * np.exp(state["log_scale"][mine])[:, None, :]
        return A @ A.transpose(0, 2, 1)

    np.testing.assert_allclose(after["position"][mine], before["position"][mine] @ linear.T + shift, atol=1e-5)
    np.testing.assert_allclose(covariance(after), linear @ covariance(before) @ linear.T, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(after["opacity_logit"][mine], before["opacity_logit"][mine])
    # Of any length, as it was.
    lengths = [np.linalg.norm(state["quaternion"][mine], axis=1) for state in (before, after)]
    np.testing.assert_allclose(lengths[1], lengths[0], rtol=1e-5)


@pytest.mark.parametrize("anchor", [0, 2, 3])
def test_colours_are_those_seen_before_in_the_direction_turned_back(states, anchor: int) -> None:
    before, after, anchors = states
    mine = anchors == anchor
    directions = np.random.default_rng(5).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    was = np.einsum("dk,nkc->ndc", sh_basis(DEGREE, directions @ TURN[anchor]), before["sh"][mine])
    now = np.einsum("dk,nkc->ndc", sh_basis(DEGREE, directions), after["sh"][mine])
    np.testing.assert_allclose(now, was, atol=2e-5)


@pytest.mark.parametrize("anchor", [0, 2, 3])
def test_moments_change_as_gradients_do(states, anchor: int) -> None:
    """A loss of the moved value y = M x has the gradient M^-T g."""
    before, after, anchors = states
    mine = anchors == anchor
    q = Rotation.from_matrix(TURN[anchor])
    from_the_left = np.stack(
        [(q * Rotation.from_quat(e, scalar_first=True)).as_quat(scalar_first=True) for e in np.eye(4)], axis=1
    )
    # SciPy knows quaternions up to their sign, which differs by column: that of the product's first row decides.
    w, x, y, z = q.as_quat(scalar_first=True)
    from_the_left *= np.sign(from_the_left[0] * [w, -x, -y, -z])
    matrices = {
        "position": np.linalg.inv(S[anchor, :3, :3]).T,
        "log_scale": np.eye(3),
        "quaternion": from_the_left,
        "sh": SH_TURN[anchor],
    }
    for name, M in matrices.items():
        for which, matrix in (("m", M), ("v", M**2)):
            expected = np.einsum("ij,nj...->ni...", matrix, before[f"{name}_{which}"][mine])
            np.testing.assert_allclose(after[f"{name}_{which}"][mine], expected, atol=2e-5, err_msg=name + which)
    for which in "mv":
        name = f"opacity_logit_{which}"
        np.testing.assert_array_equal(after[name][mine], before[name][mine])


def test_gradients_of_what_moves_are_dropped(motion: GaussianMotion, states) -> None:
    motion.gaussians.position.grad.fill(1.0)
    motion.move(S, SH_TURN)
    gradient, anchors = motion.gaussians.gradients_to_numpy()["position"], motion.gaussians.anchors()
    np.testing.assert_array_equal(gradient[:, 0] == 0, (anchors != -1) & (anchors != 1))


def test_an_anchor_without_a_motion_is_refused(motion: GaussianMotion, states) -> None:
    with pytest.raises(ValueError, match="anchor 3"):
        motion.move(S[:3], SH_TURN[:3])


def test_recoloured_gaussians_have_gain_times_colour_plus_offset_from_every_side(
    states, motion: GaussianMotion
) -> None:
    gain, offset = np.array([2.0, 0.5, 1.25]), np.array([0.1, 0.0, -0.2])
    before = motion.gaussians.to_numpy() | moments(motion.gaussians)
    motion.recolour(gain, offset, first=20)
    after = motion.gaussians.to_numpy() | moments(motion.gaussians)
    directions = np.random.default_rng(4).normal(size=(5, 3))
    basis = sh_basis(DEGREE, directions / np.linalg.norm(directions, axis=1, keepdims=True))
    colours, changed = (0.5 + np.einsum("dk,nkc->ndc", basis, state["sh"]) for state in (before, after))
    np.testing.assert_allclose(changed[:20], colours[:20])
    np.testing.assert_allclose(changed[20:], colours[20:] * gain + offset, atol=1e-5)
    # A gradient with respect to g x is that with respect to x, divided by g.
    np.testing.assert_allclose(after["sh_m"][20:], before["sh_m"][20:] / gain, rtol=1e-5)
    np.testing.assert_allclose(after["sh_v"][20:], before["sh_v"][20:] / gain**2, rtol=1e-5)

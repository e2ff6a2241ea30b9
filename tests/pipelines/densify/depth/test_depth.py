"""Depth by Gaussian processes and from the map, and the fusion of both."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.densify.depth.estimate import DepthEstimate, FusedDepth
from pipelines.densify.depth.gaussian_process import (
    GaussianProcessDepth,
    ImageGuidedDepth,
    conditioning_points,
    matern32,
    nonstationary_matern32,
    regress_log_depth,
)
from pipelines.densify.depth.sources import MapDepth
from pipelines.render.renderer import Renderer
from pipelines.settings import DepthSettings
from tests.pipelines.wall import frame, on_the_plane, pose


def covariances(count: int, seed: int) -> torch.Tensor:
    A = np.random.default_rng(seed).normal(size=(count, 2, 2))
    E = A @ A.transpose(0, 2, 1) + 0.05 * np.eye(2)
    return torch.from_numpy(np.stack([E[:, 0, 0], E[:, 0, 1], E[:, 1, 1]], 1))


def places(count: int, seed: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(-1, 1, (count, 2)))


def test_equal_covariances_give_the_matern_process_of_their_metric() -> None:
    p, q = places(7, 1), places(5, 2)
    E = covariances(1, 3)
    A = np.array([[E[0, 0], E[0, 1]], [E[0, 1], E[0, 2]]])
    d = (p[:, None] - q[None]).numpy()
    distance = np.sqrt(np.einsum("nmi,ij,nmj->nm", d, np.linalg.inv(2 * A), d) / 2)
    kernel = nonstationary_matern32(p, E.expand(7, 3), q, E.expand(5, 3))
    torch.testing.assert_close(kernel, matern32(torch.from_numpy(distance)), rtol=1e-5, atol=1e-6)


def test_varying_covariances_stay_a_process() -> None:
    p, E = places(60, 4), covariances(60, 5)
    K = nonstationary_matern32(p, E, p, E)
    torch.testing.assert_close(K, K.T)
    assert torch.linalg.eigvalsh(K).min() > -1e-7
    assert (torch.diagonal(K) > 0.999).all()


CAMERA = PinholeCamera(100.0, 100.0, 80.0, 60.0, 160, 120)


def surface(pixels: np.ndarray) -> np.ndarray:
    """Depth of a slanted, slightly curved wall."""
    x, y = pixels.T / 160
    return np.exp(1.0 + 0.4 * x - 0.2 * y + 0.1 * np.sin(4 * x))


def view(pixels: np.ndarray, depth: np.ndarray) -> Keyframe:
    image = np.zeros((120, 160, 3), dtype=np.float32)
    points = SparsePoints(CAMERA.unproject(pixels, depth), pixels, np.arange(len(pixels)))
    return KeyframeStore().append(TrackedFrame(0, 0.0, "v", image, CAMERA, np.eye(4), points))


def estimator(**settings: float) -> GaussianProcessDepth:
    return GaussianProcessDepth(DepthSettings(**settings), np.random.default_rng(0))


@pytest.fixture
def grid() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(5, 155, 15), np.linspace(5, 115, 11))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def test_a_smooth_surface_is_found_between_its_points(grid: np.ndarray) -> None:
    asked = np.random.default_rng(1).uniform([5, 5], [155, 115], (200, 2))
    estimate = estimator().estimate(view(grid, surface(grid)), [], asked)
    error = np.abs(np.log(estimate.depth / surface(asked)))
    assert np.median(error) < 0.003
    assert (estimate.deviation < 0.06).all()
    assert np.mean(error < 3 * estimate.deviation + 1e-3) > 0.95


def test_points_are_met_and_far_from_them_nothing_is_known(grid: np.ndarray) -> None:
    corner = grid[(grid < 60).all(axis=1)]
    rng = np.random.default_rng(2)
    depth = surface(corner) * np.exp(rng.normal(0, 0.3, len(corner)))  # rough: short correlation
    v = view(corner, depth)
    at = estimator().estimate(v, [], corner)
    away = estimator().estimate(v, [], np.array([[155.0, 115.0]]))
    assert at.deviation.max() < 0.7 * away.deviation[0]
    # At least the spread of the points: 0.996 to 2.3 times it in 25 draws.
    assert away.deviation[0] > 0.9 * np.log(depth).std()


def test_scale_changes_the_depth_and_not_its_deviation(grid: np.ndarray) -> None:
    asked = np.array([[33.0, 44.0], [99.0, 12.0]])
    one = estimator().estimate(view(grid, surface(grid)), [], asked)
    hundred = estimator().estimate(view(grid, 100 * surface(grid)), [], asked)
    np.testing.assert_allclose(hundred.depth, 100 * one.depth, rtol=1e-9)
    np.testing.assert_allclose(hundred.deviation, one.deviation, rtol=1e-6)


def test_points_behind_the_camera_or_outside_the_image_have_no_say(grid: np.ndarray) -> None:
    asked = np.array([[33.0, 44.0]])
    clean = estimator().estimate(view(grid, surface(grid)), [], asked)
    wrong = np.array([[40.0, 40.0], [-30.0, 50.0]])
    mixed = view(np.concatenate([grid, wrong]), np.concatenate([surface(grid), [-3.0, 9.0]]))
    np.testing.assert_array_equal(estimator().estimate(mixed, [], asked).depth, clean.depth)


def two_walls(rng: np.random.Generator) -> tuple[Keyframe, np.ndarray, np.ndarray]:
    """A red wall at depth 2 left of a wavy edge, a blue one at 3 right of it; pixels near the edge, their depths."""
    x, y = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    far = x > 80 + 20 * np.sin(y / 12)
    image = np.where(far[..., None], [0.1, 0.2, 0.9], [0.9, 0.2, 0.1]).astype(np.float32)
    depth = np.where(far, 3.0, 2.0)
    pixels = rng.integers([2, 2], [158, 118], (150, 2)) + 0.5
    column, row = pixels.astype(int).T
    points = SparsePoints(CAMERA.unproject(pixels, depth[row, column]), pixels, np.arange(150))
    view = KeyframeStore().append(TrackedFrame(0, 0.0, "v", image, CAMERA, np.eye(4), points))
    asked = np.stack([rng.integers(55, 105, 300), rng.integers(5, 115, 300)], axis=1) + 0.5
    column, row = asked.astype(int).T
    return view, asked, depth[row, column]


def test_depth_jumps_where_the_colour_does() -> None:
    view, asked, truth = two_walls(np.random.default_rng(3))
    guided = ImageGuidedDepth(DepthSettings(), np.random.default_rng(0)).estimate(view, [], asked)
    constant = estimator().estimate(view, [], asked)
    errors = [np.abs(np.log(e.depth / truth)) for e in (guided, constant)]
    assert np.mean(errors[0] > 0.1) < 0.5 * np.mean(errors[1] > 0.1)
    assert errors[0].mean() < 0.5 * errors[1].mean()


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


SQUARE = PinholeCamera(50.0, 50.0, 32.0, 24.0, 64, 48)


def test_no_more_points_than_allowed_are_drawn_and_fewer_are_all_taken() -> None:
    rng = np.random.default_rng(0)
    pixels = rng.uniform([0, 0], [64, 48], (40, 2))
    depth = np.arange(1.0, 41.0)
    points = SparsePoints(SQUARE.unproject(pixels, depth), pixels, np.arange(40))
    image = np.zeros((48, 64, 3), dtype=np.float32)
    view = KeyframeStore().append(TrackedFrame(0, 0.0, "v", image, SQUARE, np.eye(4), points))
    places, z = conditioning_points(view, 40, rng)
    np.testing.assert_array_equal(places, pixels)
    np.testing.assert_allclose(z, depth)
    draws = [conditioning_points(view, 15, rng) for _ in range(2)]
    for places, z in draws:
        assert len(set(z)) == 15
        np.testing.assert_array_equal(places, pixels[np.round(z).astype(int) - 1])
    assert not np.array_equal(draws[0][1], draws[1][1])


def test_the_conditional_is_that_of_the_joint_gaussian() -> None:
    """Against the precision matrix of all places at once, the other way to condition."""
    rng = np.random.default_rng(1)
    A = rng.normal(size=(9, 9))
    joint = A @ A.T + np.eye(9)
    depth = np.exp(rng.normal(size=6))
    noise = 0.3
    estimate = regress_log_depth(
        depth,
        torch.from_numpy(joint[:6, :6]),
        noise,
        torch.from_numpy(joint[6:, :6]),
        torch.from_numpy(np.diag(joint)[6:].copy()),
    )
    observed = joint + np.diag([noise] * 6 + [0.0] * 3)
    precision = np.linalg.inv(observed)
    covariance = np.linalg.inv(precision[6:, 6:])
    y = np.log(depth)
    mean = y.mean() - covariance @ precision[6:, :6] @ (y - y.mean())
    np.testing.assert_allclose(estimate.depth, np.exp(mean), rtol=1e-10)
    np.testing.assert_allclose(estimate.deviation, np.sqrt(np.diag(covariance)), rtol=1e-10)


VIEW = 2


@pytest.fixture
def wall(renderer: Renderer) -> Renderer:
    """A map of the left three quarters of the wall: a Gaussian a pixel of view 2."""
    x, y = np.meshgrid(np.arange(-4, 48) + 0.5, np.arange(-4, 52) + 0.5)
    xyz = on_the_plane(np.stack([x.ravel(), y.ravel()], axis=1), pose(VIEW))
    n = len(xyz)
    renderer.gaussians.load(
        {
            "position": xyz,
            "log_scale": np.full((n, 3), np.log(0.04)),
            "quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
            "opacity_logit": np.full(n, 4.0),
            "sh": np.zeros((n, 1, 3)),
        }
    )
    return renderer


def estimate(renderer: Renderer, pixels: np.ndarray, **change: float):
    view = KeyframeStore().append(frame(VIEW))
    return MapDepth(renderer, 0.01).estimate(view, [], pixels)


def test_the_depth_of_the_wall_is_known_where_the_map_is(wall: Renderer) -> None:
    x, y = np.meshgrid(np.arange(4.5, 40), np.arange(4.5, 44))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    found = estimate(wall, pixels)
    T = pose(VIEW)
    truth = on_the_plane(pixels, T) @ T[2, :3] + T[2, 3]
    assert (found.deviation < 0.06).all()
    np.testing.assert_allclose(found.depth, truth, rtol=0.02)


def test_a_hole_and_its_rim_are_not_trusted(wall: Renderer) -> None:
    pixels = np.array([[60.5, 20.5], [48.5, 20.5]])
    assert (estimate(wall, pixels).deviation > 1.0).all()


def test_the_deviation_is_how_far_the_map_is_from_the_tracked_points(wall: Renderer) -> None:
    state = wall.gaussians.to_numpy()
    T = pose(VIEW)
    centre = -T[:3, :3].T @ T[:3, 3]
    state["position"] = centre + 1.1 * (state["position"] - centre)  # ten percent too far
    state["log_scale"] += np.log(1.1)
    wall.gaussians.load(state)
    found = estimate(wall, np.array([[20.5, 20.5], [30.5, 30.5]]))
    assert (found.deviation > np.log(1.1)).all()
    assert (found.deviation < 2 * MapDepth.CAUTION * np.log(1.1)).all()

from __future__ import annotations

import numpy as np
import pytest

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.densify.depth import GaussianProcessDepth, ImageGuidedDepth
from pipelines.settings import DepthSettings

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


def test_the_process_is_the_closed_form(grid: np.ndarray) -> None:
    few = grid[::7]
    process = estimator()
    process.LENGTHS, process.NOISE_RATIOS = (0.3,), (1e-2,)  # nothing to choose
    asked = np.array([[33.0, 44.0], [99.0, 12.0]])
    estimate = process.estimate(view(few, surface(few)), [], asked)

    def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        r = np.sqrt(3) * np.linalg.norm(a[:, None] - b[None], axis=2) / 160 / 0.3
        return (1 + r) * np.exp(-r)

    y = np.log(surface(few))
    K = kernel(few, few) + 1e-2 * np.eye(len(few))
    k = kernel(asked, few)
    mean = y.mean() + k @ np.linalg.solve(K, y - y.mean())
    variance = (y - y.mean()) @ np.linalg.solve(K, y - y.mean()) / len(y)
    deviation = np.sqrt(variance * (1 - np.einsum("ij,ji->i", k, np.linalg.solve(K, k.T))))
    np.testing.assert_allclose(estimate.depth, np.exp(mean), rtol=1e-9)
    np.testing.assert_allclose(estimate.deviation, deviation, rtol=1e-6)


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


def test_no_more_points_than_allowed_condition_it(grid: np.ndarray) -> None:
    # Over twelve draws, the deviation is below the bound at 85 to 126 of the 165 points.
    estimate = estimator(max_points=12).estimate(view(grid, surface(grid)), [], grid)
    assert np.count_nonzero(estimate.deviation < 0.02) < len(grid)
    assert np.median(np.abs(np.log(estimate.depth / surface(grid)))) < 0.05


def test_without_points_nothing_is_known() -> None:
    estimate = estimator().estimate(view(np.zeros((0, 2)), np.zeros(0)), [], np.array([[3.0, 3.0]]))
    assert np.isinf(estimate.deviation).all()


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


def test_without_colour_the_guided_process_is_the_constant_one(grid: np.ndarray) -> None:
    asked = np.random.default_rng(1).uniform([5, 5], [155, 115], (50, 2))
    v = view(grid, surface(grid))  # black all over
    guided = ImageGuidedDepth(DepthSettings(), np.random.default_rng(0)).estimate(v, [], asked)
    np.testing.assert_allclose(guided.depth, estimator().estimate(v, [], asked).depth, rtol=1e-9)

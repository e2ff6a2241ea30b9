"""DepthCov's regression against its formulas in plain NumPy, and what holds for any image and any call."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.densify.depth import DepthCov, load_depthcov
from pipelines.densify.depth.depthcov import DepthCovWeights
from pipelines.settings import DepthSettings


def view(pixels: np.ndarray, depth: np.ndarray, width: int = 96, height: int = 64) -> Keyframe:
    """A view of a coloured pattern that is the same at every size."""
    camera = PinholeCamera(80.0, 80.0, width / 2, height / 2, width, height)
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    image = 0.5 + 0.5 * np.stack([np.sin(5 * x), np.cos(4 * y + x), np.sign(np.sin(3 * x * y))], 2)
    points = SparsePoints(camera.unproject(pixels, depth), pixels, np.arange(len(pixels)))
    return KeyframeStore().append(TrackedFrame(0, 0.0, "v", image.astype(np.float32), camera, np.eye(4), points))


@pytest.fixture(scope="module")
def weights(checkpoint: Path) -> DepthCovWeights:
    return load_depthcov(checkpoint)


@pytest.fixture
def points() -> tuple[np.ndarray, np.ndarray]:
    """Pixels (60, 2) and depths of a 96x64 view; some lie in the border's half pixel."""
    rng = np.random.default_rng(3)
    pixels = rng.uniform([0, 0], [96, 64], (60, 2))
    pixels[:2] = [[0.1, 0.2], [95.8, 63.9]]
    return pixels, np.exp(0.5 + 0.01 * pixels[:, 0] + rng.normal(0, 0.05, 60))


def estimator(weights: DepthCovWeights, **settings: float) -> DepthCov:
    return DepthCov(DepthSettings(**settings), weights, np.random.default_rng(0))


ASKED = np.random.default_rng(4).uniform([0, 0], [96, 64], (25, 2))


def test_the_regression_is_the_closed_form(weights: DepthCovWeights, points: tuple[np.ndarray, np.ndarray]) -> None:
    pixels, depth = points
    process = estimator(weights)
    v = view(pixels, depth)
    estimate = process.estimate(v, [], ASKED)

    maps = process.covariances(v.rgba)[0].double().numpy()  # (3, 64, 96)
    s, noise = np.exp(-1.25), 1e-2 * np.exp(-2.5)

    def place(pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(row, column) in [-1, 1], and E there."""
        row, column = pixel[1] - 0.5, pixel[0] - 0.5  # of pixel centres
        x, y, z = (map_coordinates(m, [[row], [column]], order=1, mode="reflect")[0] for m in maps)
        return np.array([2 * row / 64 + 1 / 64 - 1, 2 * column / 96 + 1 / 96 - 1]), np.array([[x, y], [y, z]])

    def kernel(one: tuple[np.ndarray, np.ndarray], two: tuple[np.ndarray, np.ndarray]) -> float:
        (p1, E1), (p2, E2) = one, two
        S = E1 + E2
        Q = (p1 - p2) @ np.linalg.inv(S) @ (p1 - p2) / 2
        C = 2 * (np.linalg.det(E1) * np.linalg.det(E2)) ** 0.25 / np.sqrt(np.linalg.det(S) + 1e-8)
        r = np.sqrt(3) * np.sqrt(Q + 1e-8)
        return s * C * (1 + r) * np.exp(-r)

    known, asked = [place(p) for p in pixels], [place(p) for p in ASKED]
    K = np.array([[kernel(a, b) for b in known] for a in known]) + noise * np.eye(len(known))
    k = np.array([[kernel(a, b) for b in known] for a in asked])
    y = np.log(depth)
    mean = y.mean() + k @ np.linalg.solve(K, y - y.mean())
    variance = [kernel(a, a) - row @ np.linalg.solve(K, row) for a, row in zip(asked, k, strict=True)]
    assert 0.05 < np.ptp(mean)
    np.testing.assert_allclose(np.log(estimate.depth), mean, atol=1e-5)  # the maps are sampled in float32
    np.testing.assert_allclose(estimate.deviation, np.sqrt(variance), rtol=1e-4)


@pytest.mark.parametrize(("width", "height"), [(75, 50), (200, 33), (20, 70)])
def test_any_image_size_gives_the_same_process(
    weights: DepthCovWeights, points: tuple[np.ndarray, np.ndarray], width: int, height: int
) -> None:
    """With a kernel that does not follow the image, only places relative to the image's sides matter."""
    pixels, depth = points
    constant = load_constant(weights)
    resize = np.array([width / 96, height / 64])
    reference = estimator(constant).estimate(view(pixels, depth), [], ASKED)
    estimate = estimator(constant).estimate(view(pixels * resize, depth, width, height), [], ASKED * resize)
    np.testing.assert_allclose(estimate.depth, reference.depth, rtol=1e-6)
    np.testing.assert_allclose(estimate.deviation, reference.deviation, rtol=1e-6)


def load_constant(weights: DepthCovWeights) -> DepthCovWeights:
    network = type(weights.network)()
    entries = dict(weights.network.state_dict())
    entries["feature_convs.0.weight"] = torch.zeros(3, 16, 1, 1)
    network.load_state_dict(entries)
    return DepthCovWeights(network.eval(), weights.log_scale, weights.log_noise)


def test_the_kernel_follows_the_image(weights: DepthCovWeights, points: tuple[np.ndarray, np.ndarray]) -> None:
    v = view(*points)
    before = estimator(weights).estimate(v, [], ASKED)
    v.rgba = v.rgba[:, ::-1]
    after = estimator(weights).estimate(v, [], ASKED)
    assert np.abs(after.deviation / before.deviation - 1).max() > 0.05


def test_an_estimate_comes_back_bit_for_bit(weights: DepthCovWeights, points: tuple[np.ndarray, np.ndarray]) -> None:
    one, two = (estimator(weights, max_points=20).estimate(view(*points), [], ASKED) for _ in range(2))
    np.testing.assert_array_equal(one.depth, two.depth)
    np.testing.assert_array_equal(one.deviation, two.deviation)


def test_without_points_nothing_is_known(weights: DepthCovWeights) -> None:
    estimate = estimator(weights).estimate(view(np.zeros((0, 2)), np.zeros(0)), [], ASKED)
    assert np.isinf(estimate.deviation).all()

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3
from fields.map.gaussians import GaussianField
from fields.map.keyframes import KeyframeStore
from pipelines.companions.hidden_gaussians import Contribution
from pipelines.render.renderer import Renderer
from tests.pipelines import reference
from tests.pipelines.scenes import CAMERA, NEAR, POSE, random_gaussians

NONE = SparsePoints(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0, dtype=np.int64))


def weights(state: dict[str, np.ndarray], pose: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Sum of alpha T over the unmasked pixels, of every Gaussian, by the plain renderer."""
    splats = reference.project(state, CAMERA, pose, NEAR)
    total, T = np.zeros(len(state["position"])), np.ones(mask.shape)
    for i, alpha in zip(splats.index, splats.alpha(CAMERA.width, CAMERA.height), strict=True):
        drawn = np.where(alpha >= reference.ALPHA_MIN, np.minimum(alpha, reference.ALPHA_MAX), 0.0)
        total[i] = (drawn * T)[mask].sum()
        T = T * (1 - drawn)
    return total


@pytest.fixture
def store() -> KeyframeStore:
    """Two views, of which the second one's left half is masked."""
    mask = np.ones((CAMERA.height, CAMERA.width), dtype=bool)
    mask[:, :20] = False
    image = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.float32)
    other = exp_se3([0.4, 0.1, 0.0, 0.0, 0.2, 0.0]) @ POSE
    store = KeyframeStore()
    store.append(TrackedFrame(0, 0.0, "a", image, CAMERA, POSE, NONE))
    store.append(TrackedFrame(1, 0.1, "b", image, CAMERA, other, NONE, mask=mask))
    return store


def test_it_is_the_largest_sum_of_weights_over_the_views(
    renderers: Callable[..., Renderer], store: KeyframeStore
) -> None:
    renderer = renderers()
    state = random_gaussians(120, seed=4)
    renderer.gaussians.load(state)
    before = renderer.view_renders
    contribution = Contribution(renderer.gaussians, renderer)
    contribution.measure(store, NEAR)
    contribution.begin()
    for view in store:  # one after the other, as all at once
        contribution.measure([view], NEAR)
    measured = renderer.gaussians.coverages()
    masks = [view.rgba[..., 3] == 255 for view in store]
    expected = [weights(state, view.T_camera_world, mask) for view, mask in zip(store, masks, strict=True)]
    np.testing.assert_allclose(measured, np.maximum(*expected), rtol=1e-3, atol=1e-3)
    assert not np.array_equal(np.argmax(expected, axis=0), np.zeros(120))  # both views count
    assert renderer.view_renders == before + 4


def test_what_no_view_shows_covers_nothing(renderers: Callable[..., Renderer], store: KeyframeStore) -> None:
    renderer = renderers()
    state = random_gaussians(20, seed=5)
    state["position"][7] = -50.0 * POSE[2, :3]  # behind both cameras
    renderer.gaussians.load(state)
    Contribution(renderer.gaussians, renderer).measure(store, NEAR)
    measured = renderer.gaussians.coverages()
    assert measured[7] == 0 and np.count_nonzero(measured) >= 10


def test_measuring_leaves_no_gradient(renderers: Callable[..., Renderer], store: KeyframeStore) -> None:
    gaussians: GaussianField = renderers().gaussians
    gaussians.load(random_gaussians(20, seed=6))
    Contribution(gaussians, renderers()).measure(store, NEAR)
    assert all(not gradient.any() for gradient in gaussians.gradients_to_numpy().values())


def test_a_coarser_level_tells_nearly_the_same_pixels_of_the_full_size(renderers: Callable[..., Renderer]) -> None:
    renderer, camera = renderers(), PinholeCamera(50.0, 48.0, 31.0, 25.0, 64, 48)
    renderer.gaussians.load(random_gaussians(120, seed=1))
    store = KeyframeStore(levels=2)
    store.append(TrackedFrame(0, 0.0, "a", np.zeros((48, 64, 3), dtype=np.float32), camera, POSE, NONE))
    contribution, measured = Contribution(renderer.gaussians, renderer), []
    for level in (0, 1):
        contribution.begin()
        contribution.measure(store, NEAR, level)
        measured.append(renderer.gaussians.coverages())
    fine, coarse = measured
    assert fine.max() > 40
    assert np.abs(coarse - fine).max() < 3.0  # 0.8 to 1.4 over ten seeds
    assert coarse.sum() == pytest.approx(fine.sum(), rel=0.02)

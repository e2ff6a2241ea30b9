from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import taichi as ti
from numpy.typing import NDArray

from fields.camera import PinholeCamera
from fields.keyframes import Keyframe, KeyframeStore
from fields.se3 import exp_se3, inverse_se3, log_se3
from fields.tracked_frame import SparsePoints, TrackedFrame
from pipelines.losses import PhotometricLoss
from pipelines.pose_refinement import PoseAlignment, PoseRefinement, pixel_metric
from pipelines.rendering import Renderer
from pipelines.settings import PoseSettings

from .scenes import CAMERA, NEAR, POSE, random_gaussians

DEPTH = 4.0


def keyframe(image: NDArray, T: NDArray, camera: PinholeCamera = CAMERA) -> Keyframe:
    """A view from T whose tracked points lie at DEPTH."""
    pixels = np.array([[10.0, 10.0], [30.0, 20.0], [20.0, 30.0]])
    T_world_camera = inverse_se3(T)
    xyz = camera.unproject(pixels, np.full(3, DEPTH)) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    image = np.clip(image, 0, 1).astype(np.float32)
    return KeyframeStore().append(
        TrackedFrame(0, 0.0, "view", image, camera, T, SparsePoints(xyz, pixels, np.arange(3)))
    )


def black() -> Keyframe:
    return keyframe(np.zeros((CAMERA.height, CAMERA.width, 3)), POSE)


def difference(renderer: Renderer, view: Keyframe, T: NDArray) -> float:
    """Mean absolute difference of the view's image and the map seen from T."""
    return float(np.abs(renderer.render(CAMERA, T, NEAR).colour - view.rgba[..., :3] / 255).mean())


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_moved_pose_comes_back_when_only_poses_are_stepped(renderers: Callable[..., Renderer], seed: int) -> None:
    """Moved by 2 percent of the depth and 0.6 degrees a axis: some two pixels of 43."""
    renderer = renderers(0, ti.f32)
    renderer.gaussians.load(random_gaussians(150, seed=21, size=(2.0, 6.0)))
    before = renderer.gaussians.to_numpy()
    offset = np.random.default_rng(seed).choice([-1.0, 1.0], 6) * np.repeat([0.02 * DEPTH, 0.01], 3)
    moved = exp_se3(offset) @ POSE
    view = keyframe(renderer.render(CAMERA, POSE, NEAR).colour, moved)
    loss = PhotometricLoss(renderer.images)
    refinement = PoseRefinement(PoseSettings())
    for _ in range(80):
        renderer.forward(CAMERA, view.T_camera_world, NEAR)
        renderer.images.set_reference(view.rgba)
        loss.forward()
        loss.backward(0.2)
        renderer.backward()
        refinement.step(view, renderer.camera_gradient(), 0.05)
    assert difference(renderer, view, view.T_camera_world) < 0.2 * difference(renderer, view, moved)
    left = log_se3(view.T_camera_world @ inverse_se3(POSE))
    assert np.linalg.norm(left[:3]) < 0.6 * np.linalg.norm(offset[:3])
    assert np.linalg.norm(left[3:]) < 0.6 * np.linalg.norm(offset[3:])
    for name, value in renderer.gaussians.to_numpy().items():
        np.testing.assert_array_equal(value, before[name])


def test_a_new_view_is_aligned_with_the_map_and_the_map_stays(renderers: Callable[..., Renderer]) -> None:
    renderer = renderers(0, ti.f32)
    renderer.gaussians.load(random_gaussians(400, seed=21, size=(3.0, 8.0), logit=(2.0, 4.0)))
    before = renderer.gaussians.to_numpy()
    offset = np.array([1.0, -1.0, 1.0, -1.0, 1.0, 1.0]) * np.repeat([0.01 * DEPTH, 0.005], 3)
    moved = exp_se3(offset) @ POSE
    view = keyframe(renderer.render(CAMERA, POSE, NEAR).colour, moved)
    PoseAlignment(PoseSettings(align_steps=20), renderer, PhotometricLoss(renderer.images)).align(view, NEAR)
    assert difference(renderer, view, view.T_camera_world) < 0.25 * difference(renderer, view, moved)
    assert view.pose_steps == 0
    for name, value in renderer.gaussians.to_numpy().items():
        np.testing.assert_array_equal(value, before[name])
    for gradient in renderer.gaussians.gradients_to_numpy().values():
        assert not gradient.any()


def test_a_view_of_what_the_map_does_not_hold_is_not_aligned(renderers: Callable[..., Renderer]) -> None:
    renderer = renderers(0, ti.f32)
    renderer.gaussians.load(random_gaussians(20, seed=21, size=(0.5, 1.0)))
    T = exp_se3([0.04, 0.0, 0.0, 0.0, 0.0, 0.0]) @ POSE
    view = keyframe(renderer.render(CAMERA, POSE, NEAR).colour, T)
    PoseAlignment(PoseSettings(align_steps=10), renderer, PhotometricLoss(renderer.images)).align(view, NEAR)
    np.testing.assert_array_equal(view.T_camera_world, T)


def test_a_unit_of_the_pixel_metric_moves_the_image_by_a_pixel() -> None:
    view = black()
    x, y = np.meshgrid((np.arange(5) + 0.5) / 5 * CAMERA.width, (np.arange(5) + 0.5) / 5 * CAMERA.height)
    pixels = np.tile(np.stack([x.ravel(), y.ravel()], axis=1), (2, 1))
    points = CAMERA.unproject(pixels, np.repeat([0.6 * DEPTH, 1.6 * DEPTH], 25))
    rng = np.random.default_rng(0)
    for _ in range(5):
        u = 1e-5 * rng.normal(size=6)
        T = exp_se3(pixel_metric(view) @ u)
        moved = CAMERA.project(points @ T[:3, :3].T + T[:3, 3]) - pixels
        assert np.sqrt((moved**2).sum(axis=1).mean()) == pytest.approx(np.linalg.norm(u), rel=1e-3)


def test_the_metric_follows_the_scale_of_the_scene() -> None:
    view, tenth = black(), black()
    tenth.median_depth = 0.1 * DEPTH
    np.testing.assert_allclose(pixel_metric(tenth)[:3], 0.1 * pixel_metric(view)[:3], atol=1e-12)
    np.testing.assert_allclose(pixel_metric(tenth)[3:], pixel_metric(view)[3:], atol=1e-12)


def test_steps_are_those_of_adam_in_the_metric_on_the_left_of_the_pose() -> None:
    torch = pytest.importorskip("torch")
    view = black()
    W = pixel_metric(view)
    u = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    oracle = torch.optim.Adam([u], lr=0.03, eps=1e-15)
    expected, rng = POSE, np.random.default_rng(0)
    for _ in range(10):
        gradient = rng.normal(size=6)
        PoseRefinement(PoseSettings()).step(view, gradient, 0.03)
        start = u.detach().clone()
        u.grad = torch.tensor(W.T @ gradient)
        oracle.step()
        expected = exp_se3(W @ (u.detach() - start).numpy()) @ expected
    np.testing.assert_allclose(view.T_camera_world, expected, atol=1e-9)


def test_a_pose_stays_rigid_over_many_steps() -> None:
    view = black()
    rng = np.random.default_rng(1)
    for _ in range(500):
        PoseRefinement(PoseSettings()).step(view, rng.normal(size=6), 0.5)
    R = view.T_camera_world[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(view.T_camera_world[3], [0, 0, 0, 1])
    np.testing.assert_array_equal(view.T_tracked, POSE)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_gradient_that_is_not_finite_moves_nothing(bad: float) -> None:
    view = black()
    PoseRefinement(PoseSettings()).step(view, np.array([0.1, 0, 0, bad, 0, 0]), 1.0)
    np.testing.assert_array_equal(view.T_camera_world, POSE)
    assert view.pose_steps == 0
    assert np.isfinite(view.pose_m).all()

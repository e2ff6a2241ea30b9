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
from pipelines.pose_refinement import PoseAlignment, PoseRefinement
from pipelines.rendering import Renderer
from pipelines.settings import PoseSettings

from .scenes import CAMERA, NEAR, POSE, random_gaussians


def keyframe(image: NDArray, T: NDArray, camera: PinholeCamera = CAMERA) -> Keyframe:
    points = SparsePoints(np.array([[0.0, 0.0, 1.0]]), np.array([[1.0, 1.0]]), np.zeros(1, dtype=np.int64))
    image = np.clip(image, 0, 1).astype(np.float32)
    return KeyframeStore().append(TrackedFrame(0, 0.0, "view", image, camera, T, points))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_moved_pose_comes_back_when_only_poses_are_stepped(renderers: Callable[..., Renderer], seed: int) -> None:
    """Moved by 2 percent of the depth and 0.6 degrees a axis: some two pixels of 43."""
    renderer = renderers(0, ti.f32)
    renderer.gaussians.load(random_gaussians(150, seed=21, size=(2.0, 6.0)))
    before = renderer.gaussians.to_numpy()
    offset = np.random.default_rng(seed).choice([-1.0, 1.0], 6) * np.repeat([0.02 * 4, 0.01], 3)
    view = keyframe(renderer.render(CAMERA, POSE, NEAR).colour, exp_se3(offset) @ POSE)
    loss = PhotometricLoss(renderer.images)
    refinement = PoseRefinement(PoseSettings(learning_rate=1e-3))
    for _ in range(80):
        renderer.forward(CAMERA, view.T_camera_world, NEAR)
        renderer.images.set_reference(view.rgba)
        loss.forward()
        loss.backward(0.2)
        renderer.backward()
        refinement.step(view, renderer.camera_gradient(), scene_depth=4.0)
    left = log_se3(view.T_camera_world @ inverse_se3(POSE))
    assert np.linalg.norm(left[:3]) < 0.5 * np.linalg.norm(offset[:3])
    assert np.linalg.norm(left[3:]) < 0.5 * np.linalg.norm(offset[3:])
    for name, value in renderer.gaussians.to_numpy().items():
        np.testing.assert_array_equal(value, before[name])


def test_a_new_view_is_aligned_with_the_map_and_the_map_stays(renderers: Callable[..., Renderer]) -> None:
    renderer = renderers(0, ti.f32)
    renderer.gaussians.load(random_gaussians(400, seed=21, size=(3.0, 8.0), logit=(2.0, 4.0)))
    before = renderer.gaussians.to_numpy()
    offset = np.array([1.0, -1.0, 1.0, -1.0, 1.0, 1.0]) * np.repeat([0.01 * 4, 0.005], 3)
    view = keyframe(renderer.render(CAMERA, POSE, NEAR).colour, exp_se3(offset) @ POSE)
    settings = PoseSettings(align_steps=60, align_rate=1e-3)
    PoseAlignment(settings, renderer, PhotometricLoss(renderer.images)).align(view, NEAR, scene_depth=4.0)

    def pixels(T: NDArray) -> NDArray:
        return CAMERA.project(before["position"] @ T[:3, :3].T + T[:3, 3])

    def displaced(T: NDArray) -> float:
        return float(np.median(np.linalg.norm(pixels(T) - pixels(POSE), axis=1)))

    assert displaced(view.T_camera_world) < 0.3 * displaced(exp_se3(offset) @ POSE)
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
    settings = PoseSettings(align_steps=10)
    PoseAlignment(settings, renderer, PhotometricLoss(renderer.images)).align(view, NEAR, scene_depth=4.0)
    np.testing.assert_array_equal(view.T_camera_world, T)


def test_the_first_step_is_the_rate_against_the_gradient_with_translation_in_scene_depths() -> None:
    view = keyframe(np.zeros((CAMERA.height, CAMERA.width, 3)), POSE)
    gradient = np.array([3.0, -0.01, 200.0, -5.0, 1e-4, 0.2])
    PoseRefinement(PoseSettings(learning_rate=1e-3)).step(view, gradient, scene_depth=7.0)
    xi = log_se3(view.T_camera_world @ inverse_se3(POSE))
    np.testing.assert_allclose(xi, -np.sign(gradient) * 1e-3 * np.repeat([7.0, 1.0], 3), rtol=1e-6)


def test_steps_are_those_of_adam_on_the_left_of_the_pose() -> None:
    torch = pytest.importorskip("torch")
    view = keyframe(np.zeros((CAMERA.height, CAMERA.width, 3)), POSE)
    refinement = PoseRefinement(PoseSettings(learning_rate=1e-3))
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    oracle = torch.optim.Adam([xi], lr=1e-3, eps=1e-15)
    expected, rng = POSE, np.random.default_rng(0)
    for _ in range(10):
        gradient = rng.normal(size=6)
        refinement.step(view, gradient, scene_depth=1.0)
        start = xi.detach().clone()
        xi.grad = torch.tensor(gradient)
        oracle.step()
        expected = exp_se3((xi.detach() - start).numpy()) @ expected
    np.testing.assert_allclose(view.T_camera_world, expected, atol=1e-9)


def test_a_pose_stays_rigid_over_many_steps() -> None:
    view = keyframe(np.zeros((CAMERA.height, CAMERA.width, 3)), POSE)
    refinement = PoseRefinement(PoseSettings(learning_rate=0.05))
    rng = np.random.default_rng(1)
    for _ in range(500):
        refinement.step(view, rng.normal(size=6), scene_depth=1.0)
    R = view.T_camera_world[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(view.T_camera_world[3], [0, 0, 0, 1])
    np.testing.assert_array_equal(view.T_tracked, POSE)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_gradient_that_is_not_finite_moves_nothing(bad: float) -> None:
    view = keyframe(np.zeros((CAMERA.height, CAMERA.width, 3)), POSE)
    PoseRefinement(PoseSettings()).step(view, np.array([0.1, 0, 0, bad, 0, 0]), scene_depth=1.0)
    np.testing.assert_array_equal(view.T_camera_world, POSE)
    assert view.pose_steps == 0
    assert np.isfinite(view.pose_m).all()

"""The depth term: its gradient against finite differences, and what it does where photometric errors say nothing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.se3 import inverse_se3
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from fields.runtime.backend import initialise
from fields.runtime.engine import ti
from pipelines.online import OnlineMapper
from pipelines.optimise.measured_depth import MeasuredDepthLoss
from pipelines.render.renderer import Renderer
from pipelines.settings import MappingSettings
from tests.pipelines.differences import central_differences
from tests.pipelines.scenes import CAMERA, NEAR, POSE, random_gaussians
from tests.room import Room, pinhole, walk

WEIGHT, DEVIATION = 0.7, 0.05
PIXELS = np.stack(np.meshgrid(np.arange(4.5, 43, 6), np.arange(3.5, 35, 5)), axis=-1).reshape(-1, 2)


def measured_view(depths: NDArray, deviation: float | None = DEVIATION) -> Keyframe:
    T = inverse_se3(POSE)
    xyz = CAMERA.unproject(PIXELS, depths) @ T[:3, :3].T + T[:3, 3]
    image = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.float32)
    points = SparsePoints(xyz, PIXELS, np.arange(len(xyz)))
    frame = TrackedFrame(0, 0.0, "0", image, CAMERA, POSE, points, depth_deviation=deviation)
    return KeyframeStore().append(frame)


def term(renderer: Renderer, view: Keyframe, state: dict[str, NDArray]) -> float:
    """The formula of the module, by NumPy."""
    renderer.gaussians.load(state)
    rendered = renderer.render(CAMERA, POSE, NEAR)
    x, y = PIXELS.astype(int).T
    z, opacity = view.points.depths(POSE), rendered.opacity[y, x]
    r = (rendered.depth[y, x] / opacity - z) / z
    return float(WEIGHT * np.mean(np.where(opacity > 0.5, DEVIATION / 2 * np.log1p((r / DEVIATION) ** 2), 0.0)))


def test_the_gradient_is_that_of_finite_differences(renderers: Callable[..., Renderer]) -> None:
    renderer = renderers(0, ti.f64)
    state = random_gaussians(5, seed=3, size=(14.0, 25.0), logit=(1.0, 2.5), beyond=-0.2)
    view = measured_view(np.random.default_rng(1).uniform(2.0, 6.0, len(PIXELS)))
    assert term(renderer, view, state) > 0
    nothing = np.zeros((CAMERA.height, CAMERA.width, 3)), *np.zeros((2, CAMERA.height, CAMERA.width))
    renderer.images.set_gradients(*nothing)
    loss = MeasuredDepthLoss(renderer.images, WEIGHT)
    assert loss.backward(view, CAMERA, 1.0)
    renderer.backward(with_depth=True)
    analytic = renderer.gaussians.gradients_to_numpy()
    loss.clear()
    for name in ("position", "log_scale", "opacity_logit"):
        numeric = central_differences(lambda moved: term(renderer, view, moved), state, name)
        assert np.abs(numeric).max() > 1e-5
        assert np.abs(analytic[name] - numeric).max() < 1e-4 * np.abs(numeric).max()


def test_views_without_measured_depths_have_no_term_and_nothing_of_the_last_view_stays(renderer: Renderer) -> None:
    renderer.gaussians.load(random_gaussians(40, seed=2))
    renderer.render(CAMERA, POSE, NEAR)
    loss, view = MeasuredDepthLoss(renderer.images, WEIGHT), measured_view(np.full(len(PIXELS), 3.0))
    assert loss.backward(view, CAMERA, 1.0)
    assert np.any(renderer.images.depth_grad.to_numpy())
    loss.clear()
    assert not loss.backward(measured_view(np.full(len(PIXELS), 3.0), None), CAMERA, 1.0)
    assert not np.any(renderer.images.depth_grad.to_numpy())
    assert not np.any(renderer.images.opacity_grad.to_numpy())


def depth_error(weight: float) -> float:
    """Median relative error of the depth at held-out poses, in a room with nearly plain walls and a noisy camera."""
    room, camera, rng = Room(contrast=0.05), pinhole(80, 60), np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5), axis=-1).reshape(-1, 2)
    frames, unseen = [], []
    for place, T in enumerate(walk(17, step=0.12)):
        if place % 4 == 2:
            unseen.append(T)
            continue
        image = np.clip(room.image(camera, T) + rng.normal(0, 1, (60, 80, 3)), 0, 255).round().astype(np.uint8)
        pixels = grid[rng.permutation(len(grid))[:200]]
        z = room.depth(camera, T, pixels) * (1 + rng.normal(0, 0.01, 200))
        T_world_camera = inverse_se3(T)
        xyz = camera.unproject(pixels, z) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
        frame = TrackedFrame.from_arrays(len(frames), image, T, intrinsics, xyz, pixels, depth_deviation=0.02)
        frames.append(frame)
    initialise("cpu")
    mapper = OnlineMapper(MappingSettings(optimise={"depth_weight": weight}), 80, 60)
    for frame in frames:
        mapper.process(frame)
    mapper.finish()
    errors = []
    for T in unseen:
        truth = room.depth(camera, T, grid).reshape(60, 80)
        errors.append(np.abs(mapper.renderer.render(camera, T, 0.01).expected_depth() - truth) / truth)
    return float(np.median(errors))


def test_where_walls_are_plain_the_depth_is_at_least_twice_as_good() -> None:
    without, measured = depth_error(0.0), depth_error(MappingSettings().optimise.depth_weight)
    assert measured < 0.5 * without

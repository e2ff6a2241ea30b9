"""The online loop and its parts on a small wall: a picture on a slanted plane, seen by a camera that moves sideways."""

from __future__ import annotations

import numpy as np
import pytest

from fields.geometry.se3 import exp_se3
from fields.map.keyframes import KeyframeStore
from pipelines import refinement
from pipelines.online import OnlineMapper
from pipelines.optimise.adam import LearningRates
from pipelines.refinement import in_steps, refine
from pipelines.settings import MappingSettings, RefineSettings
from tests.pipelines.wall import CAMERA, frame, on_the_plane, pose

SETTINGS = MappingSettings(optimise={"steps": 10}, densify={"warm_up": 2})

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def mapped(taichi_on_the_cpu: None) -> OnlineMapper:
    """A map of seven frames, and the mapper that made it."""
    mapper = OnlineMapper(SETTINGS, 64, 48, seed=1)
    mapper.compile()
    for i in range(7):
        mapper.process(frame(i))
    mapper.finish()
    return mapper


def psnr(mapper: OnlineMapper, i: int) -> float:
    f = frame(i)
    near = mapper.settings.near * mapper.keyframes.scene_depth
    T = mapper.keyframes.corrected(i, f.T_camera_world)
    colour = np.clip(mapper.renderer.render(f.camera, T, near).colour, 0, 1)
    return -10 * np.log10(((colour - f.image) ** 2).mean())


def test_frames_that_were_mapped_are_seen_again(mapped: OnlineMapper) -> None:
    assert min(psnr(mapped, i) for i in range(7)) > 24


def test_no_hole_is_left_in_the_wall(mapped: OnlineMapper) -> None:
    for i in range(7):
        opacity = mapped.renderer.render(CAMERA, mapped.keyframes[i].T_camera_world, 0.01).opacity[4:-4, 4:-4]
        assert np.mean(opacity < 0.5) < 0.005


def test_depth_is_that_of_the_wall(mapped: OnlineMapper) -> None:
    T = pose(3)
    view = mapped.renderer.render(CAMERA, T, 0.01)
    depth = view.expected_depth()[5:-5, 5:-5]
    x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    xyz = on_the_plane(np.stack([x.ravel(), y.ravel()], axis=1), T)
    truth = (xyz @ T[2, :3] + T[2, 3]).reshape(48, 64)[5:-5, 5:-5]
    assert np.median(np.abs(depth / truth - 1)) < 0.03


def test_held_out_frames_are_refused(mapped: OnlineMapper) -> None:
    before = mapped.gaussians.to_numpy()
    with pytest.raises(ValueError, match="frame 7"):
        mapped.process(frame(7, held_out=True))
    np.testing.assert_array_equal(mapped.gaussians.to_numpy()["position"], before["position"])


def test_finishing_improves_the_map_from_every_keyframe_alike(
    mapped: OnlineMapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = mapped.gaussians.to_numpy()
    mapped.gaussians.load(state | {"sh": 0.95 * state["sh"]})
    before = [psnr(mapped, i) for i in range(7)]
    views, rates = [], []
    step = mapped.optimiser.step

    def recorded(store: KeyframeStore, batch: list[int], of: LearningRates, pose_rate: float) -> float:
        views.extend(batch)
        rates.append(of.position)
        return step(store, batch, of, pose_rate)

    monkeypatch.setattr(mapped.optimiser, "step", recorded)
    mapped.settled = 0
    mapped.finish()
    passes = 7  # two for a map of many keyframes, but 48 views at least
    assert np.bincount(views).tolist() == [passes] * 7
    assert rates == sorted(rates, reverse=True) and rates[-1] < 0.5 * rates[0]
    assert np.mean([psnr(mapped, i) for i in range(7)]) > np.mean(before) + 1
    mapped.finish()  # nothing new has arrived
    assert len(views) == passes * 7
    mapped.gaussians.load(state)


def test_refinement_improves_the_map_and_leaves_the_poses(mapped: OnlineMapper) -> None:
    poses = [k.T_camera_world.copy() for k in mapped.keyframes]
    # Room to improve: the wall is shown at 46 dB already, where rounding decides.
    faded = mapped.gaussians.to_numpy()
    mapped.gaussians.load(faded | {"sh": 0.9 * faded["sh"]})
    before = np.mean([psnr(mapped, i) for i in range(7)])
    seen = []
    renders = mapped.renderer.view_renders
    refine(mapped, RefineSettings(steps=40, views=4), lambda step, _: seen.append(step))
    # Once over the keyframes for what shows, then the steps.
    assert mapped.renderer.view_renders == renders + len(mapped.keyframes) + 40 * 4
    assert np.mean([psnr(mapped, i) for i in range(7)]) > before + 3
    assert seen == list(range(1, 41))
    for keyframe, T in zip(mapped.keyframes, poses, strict=True):
        np.testing.assert_array_equal(keyframe.T_camera_world, T)


def test_rates_hold_and_poses_move_in_a_share_of_the_refinement(
    mapped: OnlineMapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, poses = mapped.gaussians.to_numpy(), [k.T_camera_world for k in mapped.keyframes]
    rates, moves = [], []
    step = mapped.optimiser.step

    def recorded(store: KeyframeStore, batch: list[int], of: LearningRates, pose_rate: float) -> float:
        rates.append(of.position)
        moves.append(pose_rate)
        return step(store, batch, of, pose_rate)

    monkeypatch.setattr(mapped.optimiser, "step", recorded)
    refine(mapped, RefineSettings(steps=11, hold=0.5, min_contribution=0.0))
    assert rates[:6] == rates[:1] * 6 and rates[10] == pytest.approx(0.01 * rates[0])
    np.testing.assert_allclose(np.diff(np.log(rates[5:])), np.log(0.01) / 5, rtol=1e-6)
    assert moves == [SETTINGS.poses.learning_rate] * 5 + [0.0] * 6
    mapped.gaussians.load(state)
    for keyframe, T in zip(mapped.keyframes, poses, strict=True):
        keyframe.T_camera_world = T


def test_refinement_removes_what_no_keyframe_shows(mapped: OnlineMapper) -> None:
    state, count = mapped.gaussians.to_numpy(), len(mapped.gaussians)
    behind = {name: values[:5].copy() for name, values in state.items()}
    behind["position"] -= [0.0, 0.0, 100.0]
    mapped.gaussians.append(**behind)
    refine(mapped, RefineSettings(steps=1, views=1, min_contribution=0.0))
    assert len(mapped.gaussians) == count + 5
    refine(mapped, RefineSettings(steps=1, views=1, min_contribution=1e-3))
    assert (mapped.gaussians.to_numpy()["position"][:, 2] > -50).all()
    mapped.gaussians.load(state)


def test_refinement_by_the_clock_does_not_render_a_large_map_once_before(
    mapped: OnlineMapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    renders = mapped.renderer.view_renders
    monkeypatch.setattr(refinement, "MOST_SWEPT", len(mapped.keyframes) - 1)
    refine(mapped, RefineSettings(views=1), schedule=in_steps(3))
    assert mapped.renderer.view_renders == renders + 3
    monkeypatch.setattr(refinement, "MOST_SWEPT", len(mapped.keyframes))
    refine(mapped, RefineSettings(views=1), schedule=in_steps(3))
    assert mapped.renderer.view_renders == renders + 3 + len(mapped.keyframes) + 3


def test_a_perturbed_pose_comes_back(mapped: OnlineMapper) -> None:
    keyframe = mapped.keyframes[3]
    truth = keyframe.T_camera_world.copy()
    state = mapped.gaussians.to_numpy()
    keyframe.T_camera_world = exp_se3([0.02, -0.015, 0.01, 0.004, -0.006, 0.005]) @ truth
    still = mapped.optimiser.rates(0.0)
    rates = type(still)(0.0, 0.0, 0.0, 0.0, 0.0)

    def pixels(T: np.ndarray) -> np.ndarray:
        return CAMERA.project(keyframe.points.xyz @ T[:3, :3].T + T[:3, 3])

    def error() -> float:
        """Pixels by which the wall's points are displaced; on a wall, moving and turning look nearly alike."""
        return float(np.linalg.norm(pixels(keyframe.T_camera_world) - pixels(truth), axis=1).mean())

    before = error()
    for _ in range(60):
        mapped.optimiser.step(mapped.keyframes, [3], rates, pose_rate=0.03)
    assert error() < 0.5 * before
    for name, value in mapped.gaussians.to_numpy().items():
        np.testing.assert_array_equal(value, state[name])
    keyframe.T_camera_world = truth


def test_transparent_gaussians_are_pruned(mapped: OnlineMapper) -> None:
    state = mapped.gaussians.to_numpy()
    state["opacity_logit"][:5] = -6.0
    mapped.gaussians.load(state)
    assert mapped.prune() == 5
    assert (mapped.gaussians.opacities() >= SETTINGS.densify.prune_opacity).all()

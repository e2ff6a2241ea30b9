"""Corrections of a tracker, on the wall of test_mapping.py, whose right poses are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fields.frames.pose_correction import CameraRevision, PoseCorrection
from fields.geometry.se3 import exp_se3, inverse_se3, motion_around, moved_points, moved_pose, scale_of
from fields.map.keyframes import KeyframeStore
from fields.runtime.backend import initialise
from pipelines.corrections import WorldMotion, motion_in_pixels, revise
from pipelines.offline import OfflineMapper
from pipelines.online import OnlineMapper
from pipelines.render.formulas import ALPHA_MIN
from pipelines.settings import MappingSettings, OfflineSettings
from tests.pipelines.wall import CAMERA, NORMAL, OFFSET, frame, pose

pytestmark = pytest.mark.slow

# The world after a correction by the world before: turned, shifted, grown.
S = np.diag([1.2, 1.2, 1.2, 1.0]) @ exp_se3([0.4, -0.1, 0.3, 0.05, 0.2, -0.1])


def correction(index: list[int], S: np.ndarray, points: bool = True) -> PoseCorrection:
    """The tracker has moved by S what these frames saw."""
    frames = [frame(i) for i in index]
    poses = np.stack([moved_pose(S, f.T_camera_world) for f in frames])
    if not points:
        return PoseCorrection(np.array(index), poses)
    ids = np.concatenate([f.points.ids for f in frames])
    xyz = np.concatenate([moved_points(S, f.points.xyz) for f in frames])
    order = np.random.default_rng(0).permutation(len(ids))
    return PoseCorrection(np.array(index), poses, ids[order], xyz[order])


# ---- poses and points ------------------------------------------------------------------------------------------------


def test_frames_go_with_the_named_ones_around_them() -> None:
    a, b = exp_se3([0.3, 0, 0.1, 0, 0.2, 0]), S
    T = [pose(i) for i in range(7)]
    motion = WorldMotion(np.array([2, 4]), np.stack([moved_pose(a, T[2]), moved_pose(b, T[4])]), np.stack([a, b]))
    for index, M in ((0, a), (2, a), (4, b), (6, b)):
        after, around = motion.of(index, T[index])
        np.testing.assert_allclose(after, moved_pose(M, T[index]), atol=1e-9)
        np.testing.assert_allclose(around, M, atol=1e-9)
    after, around = motion.of(3, T[3])
    # Half way between where it would be with either: as far from one as from the other.
    ends = [moved_pose(M, T[3]) for M in (a, b)]
    np.testing.assert_allclose(after @ inverse_se3(ends[0]), ends[1] @ inverse_se3(after), atol=1e-9)
    assert scale_of(around) == pytest.approx(np.sqrt(1.2))
    np.testing.assert_allclose(moved_pose(around, T[3]), after, atol=1e-9)


def test_a_held_out_frame_takes_its_corrected_pose_but_moves_nothing() -> None:
    store = KeyframeStore()
    store.append(frame(0))
    store.trajectory.add(frame(1, held_out=True))
    store.append(frame(2))
    moved = exp_se3([0.3, 0, 0, 0, 0, 0]) @ pose(1)
    around = revise(store, PoseCorrection(np.array([1]), moved[None]))
    np.testing.assert_array_equal(store.trajectory[1], moved)
    for i in (0, 2):
        np.testing.assert_array_equal(store.trajectory[i], frame(i).T_camera_world)
    assert around == {}


def test_frames_that_stay_are_left_alone_on_both_sides_of_those_that_move() -> None:
    store = KeyframeStore()
    for i in range(6):
        store.append(frame(i))
    moved = replace(correction([2, 3], S), others_stay=True)
    around = revise(store, moved)
    assert sorted(around) == [2, 3]
    for view in store:
        before = frame(view.index)
        M = S if view.index in (2, 3) else np.eye(4)
        np.testing.assert_allclose(view.T_camera_world, moved_pose(M, before.T_camera_world), atol=1e-9)
        np.testing.assert_allclose(around.get(view.index, np.eye(4)), M, atol=1e-9)
        known = np.isin(before.points.ids, moved.ids)  # points that moved are where the tracker says, for all frames
        expected = np.where(known[:, None], moved_points(S, before.points.xyz), before.points.xyz)
        np.testing.assert_allclose(view.points.xyz, expected, atol=1e-9)


def test_keyframes_take_poses_points_and_scale_over() -> None:
    store = KeyframeStore()
    for i in range(5):
        store.append(frame(i))
    depth = store.scene_depth
    # Frames 1 and 4 are not named, nor are the points of frame 3.
    named = correction([0, 2, 3], S)
    known = ~np.isin(named.ids, frame(3).points.ids)
    around = revise(store, PoseCorrection(named.index, named.T_camera_world, named.ids[known], named.xyz[known]))
    for i, view in enumerate(store):
        np.testing.assert_allclose(view.T_tracked, moved_pose(S, pose(i)), atol=1e-9)
        np.testing.assert_allclose(view.points.xyz, moved_points(S, frame(i).points.xyz), atol=1e-9)
        np.testing.assert_allclose(around[i], S, atol=1e-9)
    assert store.scene_depth == pytest.approx(1.2 * depth)


def test_the_lag_is_the_shift_of_the_picture() -> None:
    store = KeyframeStore()
    view = store.append(frame(0))
    assert motion_in_pixels(view, np.eye(4)) == 0.0
    # Sideways by a hundredth of the depth: the focal length is 60 pixels.
    before = view.T_tracked
    store.trajectory.revise({0: exp_se3([0.01 * view.median_depth, 0, 0, 0, 0, 0]) @ before})
    view.follow(before, np.eye(4))
    assert motion_in_pixels(view, motion_around(pose(0), view.T_tracked)) == pytest.approx(0.6, rel=1e-6)
    behind = motion_around(pose(0), exp_se3([0, 0, 0, 0, np.pi, 0]) @ pose(0))
    assert motion_in_pixels(view, behind) == np.inf


def test_an_offline_map_starts_from_the_corrected_poses_and_points(taichi_on_the_cpu: None) -> None:
    mapper = OfflineMapper(OfflineSettings(max_gaussians=1024), 64, 48)
    for i in range(3):
        mapper.process(frame(i))
    assert not mapper.correct(correction([0, 2], S)).moved
    mapper.initialise()
    for i, view in enumerate(mapper.keyframes):
        np.testing.assert_allclose(view.T_camera_world, moved_pose(S, pose(i)), atol=1e-9)
    expected = np.concatenate([moved_points(S, frame(i).points.xyz) for i in range(3)])
    np.testing.assert_allclose(mapper.gaussians.to_numpy()["position"], expected, atol=1e-5)


# ---- the map ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def mapped() -> OnlineMapper:
    """A map of five frames of the wall."""
    initialise("cpu")
    settings = MappingSettings(optimise={"steps": 5}, densify={"warm_up": 2, "pixels": 3000}, corrections={"steps": 0})
    mapper = OnlineMapper(settings, 64, 48, seed=1)
    for i in range(5):
        mapper.process(frame(i))
    return mapper


def moving(mapper: OnlineMapper, S: np.ndarray) -> PoseCorrection:
    """All keyframes and their points go with S."""
    views = list(mapper.keyframes)
    return PoseCorrection(
        np.array([view.index for view in views]),
        np.stack([moved_pose(S, view.T_tracked) for view in views]),
        np.concatenate([view.points.ids for view in views]),
        np.concatenate([moved_points(S, view.points.xyz) for view in views]),
    )


def everything(mapper: OnlineMapper) -> dict[str, np.ndarray]:
    """All that the next frame would be mapped with."""
    state = mapper.gaussians.to_numpy()
    state["anchor"] = mapper.gaussians.anchors()
    for name in ("position_m", "quaternion_v", "sh_m"):
        state[name] = getattr(mapper.gaussians, name).to_numpy()[: len(mapper.gaussians)]
    for view in mapper.keyframes:
        state[f"pose {view.index}"], state[f"points {view.index}"] = view.T_camera_world, view.points.xyz
    sizes = mapper.densifier.voxels.coarsest / 2.0 ** np.arange(mapper.densifier.voxels.levels)
    state["occupied"] = np.stack([mapper.densifier.voxels.query(state["position"], size) for size in sizes])
    state["draws"] = np.array(str(mapper.rng.bit_generator.state))
    return state


def test_a_correction_of_nothing_changes_no_bit(mapped: OnlineMapper) -> None:
    settings = mapped.settings
    changed = settings.corrections.model_copy(update={"min_pixels": 0.0, "steps": 5})
    mapped.settings = settings.model_copy(update={"corrections": changed})
    before = everything(mapped)
    assert not mapped.correct(moving(mapped, np.eye(4))).moved
    after = everything(mapped)
    for name in before:
        np.testing.assert_array_equal(after[name], before[name], err_msg=name)


def test_disabled_corrections_move_poses_alone(mapped: OnlineMapper) -> None:
    settings = mapped.settings
    disabled = settings.corrections.model_copy(update={"enabled": False})
    mapped.settings = settings.model_copy(update={"corrections": disabled})
    before, T = mapped.gaussians.to_numpy(), mapped.keyframes[2].T_tracked
    assert not mapped.correct(moving(mapped, S)).moved
    np.testing.assert_allclose(mapped.keyframes[2].T_tracked, moved_pose(S, T), atol=1e-9)
    # And back.
    mapped.correct(moving(mapped, np.linalg.inv(S)))
    np.testing.assert_array_equal(mapped.gaussians.to_numpy()["position"], before["position"])


def test_small_corrections_add_up_until_they_count(mapped: OnlineMapper) -> None:
    before, moved = mapped.gaussians.to_numpy(), mapped.keyframes[1]
    T, depth = moved.T_tracked.copy(), moved.median_depth
    shift = exp_se3([0.33 / CAMERA.focal * depth, 0, 0, 0, 0, 0])  # a third of a pixel
    poses = np.stack([view.T_tracked for view in mapped.keyframes])
    poses[1] = shift @ poses[1]
    assert not mapped.correct(PoseCorrection(np.arange(5), poses)).moved
    for name, value in mapped.gaussians.to_numpy().items():
        np.testing.assert_array_equal(value, before[name])
    np.testing.assert_array_equal(moved.T_tracked, poses[1])
    poses[1] = shift @ poses[1]
    assert mapped.correct(PoseCorrection(np.arange(5), poses)).moved
    way = mapped.gaussians.to_numpy()["position"] - before["position"]
    mine = np.array([anchor.keyframe is moved for anchor in mapped.densifier.anchors])[mapped.gaussians.anchors()]
    expected = T[:3, :3].T @ [-0.66 / CAMERA.focal * depth, 0, 0]
    np.testing.assert_allclose(way[mine], np.tile(expected, (mine.sum(), 1)), atol=1e-5)
    assert (way[~mine] == 0).all()
    assert mine.sum() > 20 and not mapped.corrector.pending


def test_corrections_in_a_row_move_the_map_once(mapped: OnlineMapper) -> None:
    """There and back again: the Gaussians have not moved in between, but the poses have."""
    before, poses = mapped.gaussians.to_numpy(), [view.T_tracked.copy() for view in mapped.keyframes]
    assert not mapped.correct(moving(mapped, S), more=True).moved
    np.testing.assert_allclose(mapped.keyframes[1].T_tracked, moved_pose(S, poses[1]), atol=1e-9)
    assert not mapped.correct(moving(mapped, np.linalg.inv(S))).moved
    np.testing.assert_array_equal(mapped.gaussians.to_numpy()["position"], before["position"])
    # On in two parts: as in one.
    mapped.correct(moving(mapped, S), more=True)
    assert mapped.correct(moving(mapped, S)).moved
    way = moved_points(S @ S, before["position"].astype(np.float64))
    np.testing.assert_allclose(mapped.gaussians.to_numpy()["position"], way, atol=1e-4)


def test_a_world_that_moves_as_a_whole_looks_as_before_in_the_voxels_of_a_fresh_insertion(mapped: OnlineMapper) -> None:
    view = mapped.keyframes[3]
    spacing = np.array([anchor.spacing for anchor in mapped.densifier.anchors])
    coarsest = mapped.densifier.voxels.coarsest
    before = mapped.renderer.render(view.camera, view.T_camera_world, mapped.near).colour
    assert mapped.correct(moving(mapped, S)).moved
    now = mapped.renderer.render(view.camera, view.T_camera_world, mapped.near).colour
    # Rounding decides whether a Gaussian at the least alpha is drawn in a pixel, which changes it by that alpha.
    off = np.abs(now - before)
    assert np.mean(off > 5e-4) < 2e-3
    assert off.max() < ALPHA_MIN + 5e-4

    assert mapped.densifier.voxels.coarsest == pytest.approx(1.2 * coarsest)
    xyz = mapped.gaussians.to_numpy()["position"].astype(np.float64)
    sizes = 1.2 * spacing[mapped.gaussians.anchors()]
    # The oracle: sets of cells in Python.
    widths = mapped.densifier.voxels.coarsest / 2.0 ** np.arange(mapped.densifier.voxels.levels)
    cells = [np.floor((xyz - mapped.densifier.voxels.origin) / width).astype(int) for width in widths]
    finest = mapped.densifier.voxels.level_of(sizes)
    marked = [set(map(tuple, cells[k][finest >= k].tolist())) for k in range(len(widths))]
    asked = np.concatenate([xyz, xyz + np.random.default_rng(0).normal(size=xyz.shape) * sizes[:, None]])
    shares = []
    for k, width in enumerate(widths):
        places = np.floor((asked - mapped.densifier.voxels.origin) / width).astype(int).tolist()
        answer = mapped.densifier.voxels.query(asked, width)
        assert answer.tolist() == [tuple(place) in marked[k] for place in places]
        shares.append(answer.mean())
    assert shares[0] > 0.9 and 0.3 < shares[4] < 0.7 and shares[7] == 0.0


# ---- the camera ------------------------------------------------------------------------------------------------------


def test_a_map_of_a_guessed_camera_becomes_that_of_the_camera_that_is_found() -> None:
    """The guess has a longer focal length. The tracker places its points on the guess's rays, at their depths."""
    initialise("cpu")
    guess = replace(CAMERA, fx=1.15 * CAMERA.fx, fy=1.15 * CAMERA.fy)

    def guessed(i: int):
        f = frame(i)
        T = f.T_camera_world
        local = f.points.xyz @ T[:3, :3].T + T[:3, 3]
        there = guess.unproject(f.points.pixels, local[:, 2])
        return replace(f, camera=guess, points=replace(f.points, xyz=(there - T[:3, 3]) @ T[:3, :3]))

    settings = MappingSettings(optimise={"steps": 10}, densify={"warm_up": 2})
    mapper = OnlineMapper(settings, 64, 48, seed=1)
    for i in range(5):
        mapper.process(guessed(i))
    before = mapper.gaussians.to_numpy()

    def off_the_wall(state: dict[str, np.ndarray]) -> np.ndarray:
        return np.abs(state["position"] @ NORMAL - OFFSET)

    right = [frame(i) for i in range(5)]
    correction = PoseCorrection(
        np.arange(5),
        np.stack([f.T_camera_world for f in right]),
        np.concatenate([f.points.ids for f in right]),
        np.concatenate([f.points.xyz for f in right]),
        CameraRevision(CAMERA),
    )
    around, moved = mapper.corrector.correct(correction, settings.corrections)
    after = mapper.gaussians.to_numpy()
    assert set(around) <= set(range(5)) and moved.tolist() == list(range(5))
    assert np.median(off_the_wall(after)) < 0.5 * np.median(off_the_wall(before))
    np.testing.assert_allclose(after["log_scale"] - before["log_scale"], np.log(1.15), atol=1e-5)
    for keyframe, f in zip(mapper.keyframes, right, strict=True):
        assert keyframe.camera == CAMERA and keyframe.pyramid[0].camera == CAMERA
        np.testing.assert_allclose(keyframe.points.xyz, f.points.xyz)
        np.testing.assert_array_equal(keyframe.rgba, f.rgba)
    mapper.process(frame(5))
    assert mapper.keyframes[-1].camera == CAMERA

"""A new map goes on with a finished one: it holds the same Gaussians and views, and grows only where nothing is."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.geometry.se3 import exp_se3
from fields.map.gaussians import NO_ANCHOR
from pipelines.online import OnlineMapper
from pipelines.whole.finished_map import FinishedMap, go_on, placed_by
from tests.pipelines.mapped_wall import finished_map, finished_mapper, fresh_mapper
from tests.pipelines.test_online import SETTINGS
from tests.pipelines.wall import frame

pytestmark = pytest.mark.slow

FRAMES = 5


class Finished(NamedTuple):
    """What a finished run keeps, the errors of its keyframes, and the PSNR of the first."""

    map: FinishedMap
    errors: NDArray[np.float64]
    psnr: float


@pytest.fixture(scope="module")
def finished() -> Finished:
    """A finished run of the wall."""
    mapper = finished_mapper(FRAMES)
    store = mapper.keyframes
    psnr = mapper.optimiser.compare(store[0], store.scene_depth).psnr
    return Finished(finished_map(mapper), store.errors(), psnr)


def gone_on(finished: Finished) -> OnlineMapper:
    mapper = fresh_mapper()
    go_on(mapper, finished.map)
    return mapper


def test_the_map_is_the_finished_one(finished: Finished) -> None:
    mapper = gone_on(finished)
    for name, array in mapper.gaussians.to_numpy().items():
        np.testing.assert_array_equal(array, finished.map.gaussians[name])
    store = mapper.keyframes
    assert [view.index for view in store.selected] == finished.map.keyframes
    assert list(mapper.trajectory) == list(range(FRAMES)) and mapper.frame_count == FRAMES
    assert store.scene_depth == pytest.approx(finished.map.scene_depth, rel=1e-2)
    assert mapper.optimiser.compare(store[0], store.scene_depth).psnr == pytest.approx(finished.psnr, abs=0.1)
    # The errors are those of the map, and not those of keyframes that nothing has optimised.
    assert store.errors().max() < 2.0 * finished.errors.max()


def test_what_the_finished_run_has_masked_stays_masked(finished: Finished) -> None:
    mask = np.full((12, 16), 255, dtype=np.uint8)
    mask[4:8] = 0
    masked = list(finished.map.keyframes)[1]
    mapper = fresh_mapper()
    go_on(mapper, replace(finished.map, masks={masked: mask}))
    for view in mapper.keyframes:
        assert (view.transient is mask) == (view.index == masked)
        rows = (view.rgba[..., 3] == 0).all(axis=1)
        assert rows[18:30].all() == (view.index == masked)
        assert not rows[:14].any()


def test_every_gaussian_has_the_first_keyframe_that_shows_it_as_anchor(finished: Finished) -> None:
    mapper = gone_on(finished)
    anchors, store = mapper.gaussians.anchors(), mapper.keyframes
    position = mapper.gaussians.to_numpy()["position"].astype(np.float64)
    np.testing.assert_array_equal(anchors, placed_by(store, position, mapper.near))
    assert (anchors != NO_ANCHOR).mean() > 0.95
    assert [anchor.keyframe for anchor in mapper.densifier.anchors] == list(store)
    for place in np.unique(anchors[anchors != NO_ANCHOR]):
        for earlier in range(place):
            view = store[earlier]
            local = position[anchors == place] @ view.T_camera_world[:3, :3].T + view.T_camera_world[:3, 3]
            ahead = local[:, 2] > mapper.near
            assert not view.camera.contains(view.camera.project(local[ahead])).any()


def test_the_voxels_of_the_map_are_taken(finished: Finished) -> None:
    mapper = gone_on(finished)
    assert mapper.densifier.voxels is not None
    known = mapper.gaussians.anchors() != NO_ANCHOR
    position = mapper.gaussians.to_numpy()["position"].astype(np.float64)[known]
    spacing = min(anchor.spacing for anchor in mapper.densifier.anchors)
    assert mapper.densifier.voxels.query(position, 2.0 * spacing).mean() > 0.95
    # Half of a view's points stay out, where the optimiser has left a Gaussian. Without the marks, all come again.
    grown = []
    for _ in range(2):
        before = len(mapper.gaussians)
        mapper.densifier.add_tracked_points(mapper.keyframes[-1])
        grown.append(len(mapper.gaussians) - before)
        mapper.densifier.voxels.clear()
        mapper.densifier.voxels.settle(mapper.densifier.voxels.coarsest, mapper.densifier.voxels.origin)
    assert grown[0] < 0.7 * grown[1]


def test_a_correction_of_later_frames_leaves_the_finished_map_alone(finished: Finished) -> None:
    mapper = gone_on(finished)
    for i in range(FRAMES, FRAMES + 3):
        mapper.process(frame(i))
    later = [view.index for view in mapper.keyframes if view.index >= FRAMES]
    assert later, "a frame after the finished map is a keyframe"
    poses = [view.T_camera_world.copy() for view in mapper.keyframes if view.index < FRAMES]
    anchors = mapper.gaussians.anchors()
    old = (anchors >= 0) & (anchors < len(poses))
    before = mapper.gaussians.to_numpy()["position"][old]
    away = np.stack([exp_se3([0.3, 0, 0, 0, 0.1, 0]) @ mapper.trajectory[i] for i in later])
    mapper.corrector.correct(PoseCorrection(np.array(later), away, others_stay=True), SETTINGS.corrections)
    np.testing.assert_array_equal(mapper.gaussians.to_numpy()["position"][old], before)
    for view, T in zip(mapper.keyframes, poses, strict=False):
        np.testing.assert_array_equal(view.T_camera_world, T)

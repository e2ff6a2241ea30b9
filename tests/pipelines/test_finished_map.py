"""A new map continues a finished one; frames between keyframes are views."""

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
from pipelines.pipeline import FrameReport
from pipelines.settings import MappingSettings
from pipelines.whole.finished_map import FinishedMap, go_on
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


def mapped(**keyframes) -> tuple[OnlineMapper, list[FrameReport]]:
    """Map six frames, of which the first and the fifth are keyframes."""
    apart = {"covisibility": 0.0, "baseline": 9.0, "max_gap": 3}
    settings = MappingSettings(optimise={"steps": 20}, densify={"warm_up": 2}, keyframes=apart | keyframes)
    mapper = fresh_mapper(settings)
    return mapper, [mapper.process(frame(i)) for i in range(6)]


def test_frames_between_keyframes_are_views_that_get_tracked_points_alone() -> None:
    mapper, reports = mapped(between=2)
    assert [report.is_keyframe for report in reports] == [i in (0, 4) for i in range(6)]
    assert [report.keyframes for report in reports] == [1, 1, 1, 1, 2, 2]
    assert [(view.index, view.is_between) for view in mapper.keyframes] == [(0, False), (2, True), (4, False)]
    added = np.diff([0, *(report.gaussians for report in reports)])
    assert added[[1, 2, 3, 5]].max() <= 120 < added[4]
    optimised, began = mapper.keyframes[1].error, mapper.keyframes[0].error
    assert optimised < 0.2, f"the new view began with an error of 1, the first keyframe ended with {began}"


def test_without_the_setting_keyframes_are_the_only_views() -> None:
    mapper, _ = mapped()
    assert [view.index for view in mapper.keyframes] == [0, 4]

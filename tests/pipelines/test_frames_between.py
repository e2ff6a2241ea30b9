"""Frames between keyframes as views of optimisation, on the small wall."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.online import OnlineMapper
from pipelines.pipeline import FrameReport
from pipelines.settings import MappingSettings
from tests.pipelines.mapped_wall import fresh_mapper
from tests.pipelines.wall import frame

pytestmark = pytest.mark.slow


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

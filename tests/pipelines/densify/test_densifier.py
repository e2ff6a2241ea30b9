"""Which keyframe gets Gaussians at pixels of high error, and when."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from fields.map.keyframe import Keyframe
from fields.runtime.backend import initialise
from pipelines.densify.depth.estimate import DepthEstimate, unknown_depth
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from tests.pipelines.wall import NORMAL, OFFSET, frame, on_the_plane

SETTINGS = MappingSettings(optimise={"steps": 1}, poses={"enabled": False})

pytestmark = pytest.mark.slow


class SeenAgain:
    """Knows depth in the views that a later keyframe follows, and nowhere else."""

    def estimate(self, view: Keyframe, neighbours: Sequence[Keyframe], pixels: np.ndarray) -> DepthEstimate:
        if not any(other.index > view.index for other in neighbours):
            return unknown_depth(len(pixels))
        T = view.T_camera_world
        return DepthEstimate(on_the_plane(pixels, T) @ T[2, :3] + T[2, 3], np.full(len(pixels), 0.01))


def test_what_comes_into_view_with_a_keyframe_is_placed_once_the_next_one_sees_it_too() -> None:
    initialise("cpu")
    mapper = OnlineMapper(SETTINGS, 64, 48, seed=1, depth=SeenAgain())
    tracked = len(frame(0).points)
    mapper.process(frame(0))
    assert mapper.gaussian_count <= tracked
    mapper.process(frame(1))
    placed = mapper.gaussians.anchors() == 0  # by the first keyframe
    assert placed.sum() > tracked + 50
    distance = mapper.gaussians.to_numpy()["position"][placed] @ NORMAL - OFFSET
    assert np.median(np.abs(distance)) < 0.02

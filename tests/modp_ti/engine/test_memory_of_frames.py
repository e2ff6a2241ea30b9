"""What a mapper keeps of its frames counts as memory too: it ends where the budget does, and the poses go on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from fields.runtime.backend import initialise
from modp_ti.engine.mapper import Mapper
from modp_ti.inputs.tracked_points import TrackedPoints
from pipelines.settings import MappingSettings
from tests.pipelines.wall import frame

pytestmark = pytest.mark.slow

SETTINGS = MappingSettings(optimise={"steps": 1}, densify={"warm_up": 1}, depth={"sources": ["image"]}, sh_degree=0)
FRAMES, POINTS = 12, 120


def mapped(memory: float | None) -> Mapper:
    """A map of twelve frames, each with points of its own, in so much memory [GB]."""
    initialise("cpu")
    mapper = Mapper(64, 48, SETTINGS.model_copy(update={"memory": memory}), seed=1)
    for i in range(FRAMES):
        mapper.add(frame(i, held_out=i % 3 == 2))
    return mapper


@pytest.fixture(scope="module")
def half(taichi_on_the_cpu: None) -> int:
    """Half the bytes that a map of all frames takes."""
    return mapped(None).pipeline.budget.held() // 2


def test_observations_end_with_the_memory_and_are_counted(half: int, tmp_path: Path) -> None:
    mapper = mapped(half / 1e9)
    budget, points = mapper.pipeline.budget, mapper.frames.points
    seen = [len(rows) for rows in points.rows]
    kept = seen.index(0)
    assert 0 < kept < FRAMES and seen == [POINTS] * kept + [0] * (FRAMES - kept)
    assert budget.safeguards.observations_without_room == (FRAMES - kept) * POINTS
    assert budget.beside == points.nbytes and budget.held() <= 1.1 * half
    assert "observations" in budget.safeguards.warning()
    assert len(mapper.trajectory()) == FRAMES

    mapper.save(tmp_path)
    model = pycolmap.Reconstruction(tmp_path / "colmap")
    assert (model.num_images(), model.num_points3D()) == (FRAMES, kept * POINTS)


def test_points_with_frames_left_out_come_back_from_their_state() -> None:
    points = TrackedPoints()
    for i in range(4):
        if i == 2:
            points.leave_out(frame(i))
        else:
            points.add(frame(i))
    again = TrackedPoints()
    again.restore(points.state(), [False] * 4)
    assert again.nbytes == points.nbytes == 3 * POINTS * (12 + 64)
    for name, array in points.state().items():
        np.testing.assert_array_equal(again.state()[name], array)
    again.add(frame(4))
    assert [len(rows) for rows in again.rows] == [POINTS, POINTS, 0, POINTS, POINTS]

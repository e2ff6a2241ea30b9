"""Maps at their limits: frames of several shapes, more frames than the memory holds, and a damaged file of blocks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.runtime.backend import initialise
from modp_ti.engine.mapper import Mapper
from modp_ti.inputs.delivered_frames import TrackedPoints
from pipelines.companions.block_files import BlockError
from pipelines.settings import MappingSettings
from tests.pipelines.wall import frame, walked_along

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
            points.leave_out()
        else:
            points.add(frame(i))
    again = TrackedPoints()
    again.restore(points.state())
    assert again.nbytes == points.nbytes == 3 * POINTS * (12 + 64)
    for name, array in points.state().items():
        np.testing.assert_array_equal(again.state()[name], array)
    again.add(frame(4))
    assert [len(rows) for rows in again.rows] == [POINTS, POINTS, 0, POINTS, POINTS]


def test_the_frame_at_which_it_is_found_belongs_to_the_map_without_it() -> None:
    initialise("cpu")
    settings = MappingSettings(sh_degree=0, optimise={"steps": 1}, densify={"warm_up": 2}, max_gaussians=3072)
    mapper = Mapper(64, 48, settings, seed=1)
    for index in range(13):
        mapper.add(walked_along(index, index))
    file = next(iter(mapper.online.paging.away)).stored.path
    file.write_bytes(bytes(file.stat().st_size))
    with pytest.raises(BlockError, match=f"{file}: a block of the map is damaged"):
        for index in range(13, 26):
            mapper.add(walked_along(index, 25 - index))
    index = len(mapper.frames) - 1
    assert 13 <= index < 26 and mapper.frames.name[-1] == f"{index}"
    while True:
        try:
            version = mapper.version()
            break
        except BlockError:  # the next of that file
            continue
    assert len(version.trajectory) == len(mapper.frames)


def cropped(whole: TrackedFrame, left: int, right: int) -> TrackedFrame:
    """The columns of a frame from `left` to before `right`, as the image of another camera."""
    camera = replace(whole.camera, cx=whole.camera.cx - left, width=right - left)
    points = replace(whole.points, pixels=whole.points.pixels - (left, 0))
    inside = camera.contains(points.pixels)
    points = SparsePoints(points.xyz[inside], points.pixels[inside], points.ids[inside])
    image = np.ascontiguousarray(whole.image[:, left:right])
    return replace(whole, image=image, camera=camera, points=points)


def test_frames_of_several_shapes_make_one_map() -> None:
    initialise("cpu")
    mapper = Mapper(64, 48, MappingSettings(optimise={"steps": 10}, densify={"warm_up": 2}), seed=1)
    frames = [cropped(frame(i), 20, 52) if i % 2 else frame(i) for i in range(6)]
    for each in frames:
        mapper.add(each)
    mapper.refine(20)
    for each, T in zip(frames, mapper.trajectory(), strict=True):
        render = np.clip(mapper.render(each.camera, T).colour, 0, 1)
        assert render.shape == each.image.shape
        assert -10 * np.log10(((render - each.image) ** 2).mean()) > 24

"""Something walks past while the wall is mapped, or has come or gone between two visits. What is left is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.se3 import exp_se3
from pipelines.companions.changes import ChangeSweep, EarlierVisit
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from pipelines.state import MapState, restore_state, save_state
from pipelines.whole.finished_map import FinishedMap, go_on
from tests.pipelines.mapped_wall import fresh_mapper
from tests.pipelines.wall import FRAMES, WALKED, still, walked, walker
from tests.room import Room, RoomRecording, pinhole, walk

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("taichi_on_the_cpu")]


@dataclass(frozen=True)
class Mapped:
    """A mapper, whose fields are gone when the next one is made, the PSNR of its map, and its state."""

    mapper: OnlineMapper
    psnr: float
    state: MapState

    @property
    def masked(self) -> np.ndarray:
        """Which pixels (N, 48, 64) of the keyframes have less than half of their weight."""
        return np.stack([view.rgba[..., 3] < 128 for view in self.mapper.keyframes])


@cache
def mapped(walks: bool, transients: bool) -> Mapped:
    mapper = fresh_mapper(MappingSettings(**WALKED, transients=transients))
    for i in range(FRAMES):
        mapper.process(walked(i) if walks else still(i))
    mapper.finish()
    state = save_state(mapper)
    arrays = {name: np.array(array) for name, array in state.arrays.items()}
    return Mapped(mapper, psnr_of_wall(mapper), MapState(arrays, state.numbers))


def psnr_of_wall(mapper: OnlineMapper) -> float:
    """PSNR of the wall alone from where something was seen to walk."""
    errors = []
    for view in mapper.keyframes:
        shown = np.clip(mapper.renderer.render(view.camera, view.T_camera_world, mapper.near).colour, 0, 1)
        errors.append(((shown - still(view.index).image) ** 2).mean())
    return float(-10 * np.log10(np.mean(errors)))


def test_what_walks_is_masked_and_leaves_the_map() -> None:
    found = mapped(walks=True, transients=True)
    there = np.stack([walker(view.index) for view in found.mapper.keyframes])
    assert (found.masked & there).sum() > 0.6 * there.sum()
    assert (found.masked & there).sum() > 0.4 * found.masked.sum()
    assert found.psnr > mapped(walks=True, transients=False).psnr + 1.0


def test_nothing_is_masked_where_nothing_moves() -> None:
    found = mapped(walks=False, transients=True)
    assert all(view.transient is None for view in found.mapper.keyframes)
    assert found.psnr == mapped(walks=False, transients=False).psnr


def test_a_restored_map_has_its_masks() -> None:
    found = mapped(walks=True, transients=True)
    again = fresh_mapper(MappingSettings(**WALKED, transients=True))
    restore_state(again, found.state, [walked(i) for i in range(FRAMES)])
    assert any(view.transient is not None for view in found.mapper.keyframes)
    for old, new in zip(found.mapper.keyframes, again.keyframes, strict=True):
        np.testing.assert_array_equal(old.rgba, new.rgba)
        assert (old.transient is None) == (new.transient is None)


CAMERA = pinhole(80, 60)

VISIT, STEP = 16, 0.15

SETTINGS = MappingSettings(sh_degree=0, optimise={"steps": 2})

# The high box, the only piece whose number the rooms differ in.
BOX = 2


def visit(room: Room, number: int) -> list[TrackedFrame]:
    """The frames of a visit, each along another path and with tracked points of its own."""
    aside = exp_se3([0.0, 0.15 * number, 0.1 * number, 0.03 * number, 0.0, 0.0])
    poses = [aside @ T for T in walk(VISIT, STEP)]
    recording = RoomRecording(room, CAMERA, poses, points=240, views=8, seed=number)
    first = number * VISIT
    return [
        replace(
            frame,
            index=first + frame.index,
            timestamp=first / 10 + frame.timestamp,
            points=SparsePoints(frame.points.xyz, frame.points.pixels, frame.points.ids + 10_000 * number),
        )
        for frame in recording.frames()
    ]


def is_held_out(frame: TrackedFrame) -> bool:
    return frame.index % 5 == 2


@cache
def finished(room: Room) -> FinishedMap:
    """The map of a first visit."""
    mapper = fresh_mapper(SETTINGS, size=(CAMERA.width, CAMERA.height))
    mapped = [frame for frame in visit(room, 0) if not is_held_out(frame)]
    for frame in mapped:
        mapper.process(frame)
    mapper.finish()
    store = mapper.keyframes
    mapped = [replace(f, T_camera_world=store.corrected(f.index, f.T_camera_world)) for f in mapped]
    selected = [view.index for view in store.selected]
    return FinishedMap(mapper.gaussians.to_numpy(), mapped, selected, {}, store.scene_depth)


@dataclass(frozen=True)
class SecondVisit:
    """What a mapper, whose fields are gone when the next one is made, has made of a second visit.

    Attributes:
        psnr: Of the held-out frames of the second visit [dB].
        masked: Share of each earlier keyframe's pixels that is masked, where there is a mask.
        hit: Share of what is masked that shows the box or what is beside it.
        values: The map.
    """

    psnr: float
    masked: list[float]
    hit: float
    values: dict[str, np.ndarray]


def mapped_on(earlier: FinishedMap, frames: list[TrackedFrame], boxes: list[np.ndarray], watches: bool) -> SecondVisit:
    mapper = fresh_mapper(SETTINGS, size=(CAMERA.width, CAMERA.height))
    go_on(mapper, earlier)
    if watches:
        visit = EarlierVisit(earlier.gaussians, VISIT)
        sweep = ChangeSweep(visit, mapper.gaussians, mapper.keyframes, mapper.renderer, mapper.paging)
        mapper.companions.append(sweep)
    for frame in frames:
        if not is_held_out(frame):
            mapper.process(frame)
    mapper.finish()
    masks = {view.index: view.rgba[..., 3] < 128 for view in mapper.keyframes if view.transient is not None}
    assert all(index < VISIT for index in masks)
    covered = sum(mask.sum() for mask in masks.values())
    hit = sum((mask & boxes[index]).sum() for index, mask in masks.items())
    return SecondVisit(
        psnr(mapper, [frame for frame in frames if is_held_out(frame)]),
        [float(mask.mean()) for mask in masks.values()],
        float(hit / max(covered, 1)),
        mapper.gaussians.to_numpy(),
    )


def psnr(mapper: OnlineMapper, frames: list[TrackedFrame]) -> float:
    errors = []
    for frame in frames:
        shown = np.clip(mapper.renderer.render(frame.camera, frame.T_camera_world, mapper.near).colour, 0, 1)
        errors.append(((shown - frame.image) ** 2).mean())
    return float(-10 * np.log10(np.mean(errors)))


def shows_the_box(full: list[TrackedFrame], bare: list[TrackedFrame]) -> list[np.ndarray]:
    return [np.abs(a.image - b.image).max(axis=2) > 0.02 for a, b in zip(full, bare, strict=True)]


@pytest.mark.parametrize("comes", [False, True])
def test_what_has_changed_is_as_the_second_visit_saw_it(room: Room, comes: bool) -> None:
    bare = Room(without=[BOX])
    before, after = (bare, room) if comes else (room, bare)
    boxes = shows_the_box(visit(room, 0), visit(bare, 0))
    earlier, frames = finished(before), visit(after, 1)
    watched = mapped_on(earlier, frames, boxes, watches=True)
    blind = mapped_on(earlier, frames, boxes, watches=False)
    assert watched.psnr > blind.psnr + 3.0
    assert len(watched.masked) > 5 and max(watched.masked) < 0.4
    assert watched.hit > 0.4


def test_where_nothing_has_changed_the_map_is_the_same(room: Room) -> None:
    earlier, frames = finished(room), visit(room, 1)
    nothing = [np.zeros((CAMERA.height, CAMERA.width), dtype=bool)] * VISIT
    watched = mapped_on(earlier, frames, nothing, watches=True)
    assert watched.masked == []
    for name, array in mapped_on(earlier, frames, nothing, watches=False).values.items():
        np.testing.assert_array_equal(watched.values[name], array)

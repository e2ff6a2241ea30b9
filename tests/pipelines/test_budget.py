"""Maps within a budget of memory, and large ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from fields.map.gaussians import GaussianField
from fields.runtime.backend import initialise
from fields.runtime.engine import ti
from pipelines.online import OnlineMapper
from pipelines.safeguards import Safeguards
from pipelines.settings import MappingSettings
from tests.pipelines.wall import frame

pytestmark = pytest.mark.slow

FRAMES = 6
VIEWS = MappingSettings().views


@dataclass
class Mapped:
    """What is left of a map."""

    gaussians: dict[str, np.ndarray]
    keyframes: list[int]  # their frames
    safeguards: Safeguards
    held: int  # what the budget says [bytes]
    counted: int  # what its arrays hold [bytes]
    renders: int  # views that it was optimised for


def mapped(memory: float | None, frames: int = FRAMES) -> Mapped:
    """A map of so many frames with so much memory [GB]."""
    initialise("cpu")
    settings = MappingSettings(sh_degree=0, optimise={"steps": 2}, densify={"warm_up": 2}, memory=memory)
    mapper = OnlineMapper(settings, 64, 48, seed=1)
    mapper.compile()
    for i in range(frames):
        mapper.process(frame(i))
    mapper.finish()
    images = sum(level.rgba.nbytes for view in mapper.keyframes for level in view.pyramid)
    points = sum(a.nbytes for v in mapper.keyframes for a in (v.points.xyz, v.points.pixels, v.points.ids))
    bricks = len({tuple(place[:3]) for place in mapper.densifier.voxels.marks()[0].tolist()})
    return Mapped(
        mapper.gaussians.to_numpy(),
        [view.index for view in mapper.keyframes],
        mapper.caught(),
        mapper.budget.held(),
        len(mapper.gaussians) * 292 + images + points + bricks * 256,
        mapper.renderer.view_renders,
    )


@pytest.fixture(scope="module")
def free(taichi_on_the_cpu: None) -> Mapped:
    return mapped(None)


@pytest.mark.parametrize("sh_degree", [0, 2])
@pytest.mark.parametrize("real", [ti.f32, ti.f64])
def test_a_gaussian_takes_what_its_fields_hold(taichi_on_the_cpu: None, sh_degree: int, real: object) -> None:
    initialise("cpu")
    gaussians = GaussianField(sh_degree, 1024, real)
    gaussians.append(
        np.zeros((1, 3)), np.zeros((1, 3)), np.eye(4)[:1], np.zeros(1), np.zeros((1, gaussians.sh_count, 3))
    )
    values = sum(array.nbytes for array in gaussians.to_numpy().values())
    # Values, gradients and two moments; four integers; slot, and tangent with its gradient.
    assert gaussians.bytes_each == 4 * values + 4 * 4 + 4 + 2 * 6 * np.dtype(gaussians.dtype).itemsize


def test_the_budget_adds_up_what_the_map_holds(free: Mapped) -> None:
    assert free.held == free.counted


def test_nothing_is_refused_without_a_limit_or_below_it(free: Mapped) -> None:
    assert free.safeguards.warning() is None
    roomy = mapped(free.held / 1e9 * 1.5)
    assert roomy.safeguards.warning() is None
    for name, array in free.gaussians.items():
        np.testing.assert_array_equal(roomy.gaussians[name], array)


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_a_map_ends_within_its_memory_and_says_what_had_no_room(free: Mapped, share: float) -> None:
    limit = share * free.held
    tight = mapped(limit / 1e9)
    assert tight.held <= limit
    assert tight.safeguards.gaussians_without_room > 0 and "mapping.memory" in tight.safeguards.warning()
    assert 0 < len(tight.gaussians["position"]) < len(free.gaussians["position"])
    assert len(tight.keyframes) + tight.safeguards.keyframes_without_room == FRAMES


def test_frames_without_room_go_on_optimising_the_map(free: Mapped) -> None:
    memory = 0.7 * free.held / 1e9
    tight = mapped(memory)
    kept = len(tight.keyframes)
    assert tight.keyframes == list(range(kept)) and 0 < kept < FRAMES
    # The fifth part of two steps, but one at least, for as many views.
    assert tight.renders - mapped(memory, kept).renders == (FRAMES - kept) * VIEWS.per_step


def test_frames_between_keyframes_leave_half_of_the_memory_to_the_map(free: Mapped) -> None:
    taken = []
    for memory in (None, free.held / 1e9, free.held / 4e9):
        initialise("cpu")
        keyframes = {"covisibility": 0.0, "baseline": 9.0, "between": 1}
        settings = MappingSettings(sh_degree=0, optimise={"steps": 1}, keyframes=keyframes, memory=memory)
        mapper = OnlineMapper(settings, 64, 48, seed=1)
        mapper.process(frame(0))
        held, fits = mapper.budget.held(), mapper.keyframes.bytes_of(frame(1))
        mapper.process(frame(1))
        taken.append(len(mapper.keyframes) == 2)
        assert taken[-1] == (memory is None or held + fits <= 0.5e9 * memory)
        assert mapper.caught().keyframes_without_room == 0
    assert taken == [True, True, False]

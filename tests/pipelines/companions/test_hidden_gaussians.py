"""Gaussians that hardly show are removed while the map grows; views of a place apart leave those of others."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fields.map.keyframes import KeyframeStore
from fields.runtime.backend import initialise
from pipelines.companions.hidden_gaussians import HiddenGaussians
from pipelines.companions.pace import CompletePace, Plan
from pipelines.companions.paging import Paging
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from tests.pipelines.two_walls import APART, changed, moved, shares, two_walls
from tests.pipelines.wall import frame

SETTINGS = MappingSettings(densify={"warm_up": 2, "prune_every": 3})


class Sweeping(CompletePace):
    """Sweeps over so many keyframes with every keyframe from the third on."""

    def __init__(self, count: int) -> None:
        super().__init__(SETTINGS)
        self.count = count

    def plan(self, level: int, keyframes: int, frames: int) -> Plan:
        return Plan(0.0, 1, swept=self.count if keyframes >= 3 else 0)


def add_behind(mapper: OnlineMapper, distance: float, anchor: int = -1) -> None:
    """Add five Gaussians where no view sees them."""
    behind = {name: values[:5].copy() for name, values in mapper.gaussians.to_numpy().items()}
    behind["position"] -= [0.0, 0.0, distance]
    mapper.gaussians.append(**behind, anchor=anchor)


def count_behind(mapper: OnlineMapper, distance: float) -> int:
    depth = mapper.gaussians.to_numpy()["position"][:, 2]
    return int(((depth > -distance - 50.0) & (depth < -distance + 50.0)).sum())


def test_mapping_removes_what_hardly_shows_unless_it_is_young(taichi_on_the_cpu: None) -> None:
    initialise("cpu")
    mapper = OnlineMapper(SETTINGS, 64, 48, seed=1, pace=Sweeping(3))
    for i in range(2):
        mapper.process(frame(i))
    add_behind(mapper, 100.0)
    add_behind(mapper, 200.0, anchor=0)  # placed in a keyframe, of which there are few
    mapper.process(frame(2))
    assert [count_behind(mapper, 100.0), count_behind(mapper, 200.0)] == [0, 5]
    assert len(mapper.gaussians) >= 3 * 100  # nothing was lost that shows


def test_a_sweep_in_parts_removes_the_same_once_it_has_seen_all_keyframes(taichi_on_the_cpu: None) -> None:
    """Two keyframes with each new one: the sweep that begins at the third ends at the fourth."""
    initialise("cpu")
    mapper = OnlineMapper(SETTINGS, 64, 48, seed=1, pace=Sweeping(2))
    for i in range(2):
        mapper.process(frame(i))
    add_behind(mapper, 100.0)
    left = []
    for i in range(2, 6):
        if i == 3:
            add_behind(mapper, 200.0, anchor=0)
        mapper.process(frame(i))  # transparent Gaussians are pruned in between, which changes the places of others
        left.append(count_behind(mapper, 100.0))
    assert len(mapper.keyframes) == 6
    assert left == [5, 0, 0, 0]
    assert count_behind(mapper, 200.0) == 5  # placed while the sweep went on
    assert len(mapper.gaussians) >= 3 * 100


def sweeps(missing: list[int], already: int = 0, apart: int | None = None) -> dict[int, list[int]]:
    """The keyframes that are swept when each comes, of a growing map without Gaussians.

    Args:
        missing: Gaussians on disk that each keyframe sees, of which 10 are few.
        already: Number of keyframes that come with a finished map.
        apart: Number of keyframes at the first place, if another one far away follows.
    """
    store = KeyframeStore()
    one = frame(0)
    there = moved(one, APART)
    none = np.zeros(0, dtype=np.int32)
    gaussians = SimpleNamespace(anchors=lambda: none, coverages=lambda: none, remove=lambda kept: 0)
    densifier = SimpleNamespace(
        keyframes=store,
        gaussians=gaussians,
        first_anchor_since=lambda keyframe: 0,
        anchors_at=lambda keyframes: none.astype(bool),
    )
    budget = SimpleNamespace(limit=None, voxels=None)
    paging = Paging(gaussians, store, budget, SETTINGS)
    paging.most_missing = 10
    paging.before_views = paging.away.remove_hidden = lambda *_: None
    measured: list[int] = []
    contribution = SimpleNamespace(
        begin=measured.clear, measure=lambda views, near, level: measured.extend(view.index for view in views)
    )
    hidden = HiddenGaussians(contribution, densifier, paging, 0.5)
    found = {}
    for number, count in enumerate(missing):
        view = store.append(replace(one if apart is None or number < apart else there, index=number))
        paging.away.missing[view.index] = count
        if number == apart:
            store.begins.add(number)
        if number >= already:
            measured.clear()
            hidden.sweep_when_due(0.1)
            if measured:
                found[number + 1] = list(measured)
    return found


def test_all_keyframes_are_swept_each_time_that_the_keyframes_are_half_as_many_again() -> None:
    assert sweeps([0] * 400) == {n: list(range(n)) for n in (64, 96, 144, 216, 324)}


def test_far_keyframes_are_left_out_and_make_sweeps_no_rarer() -> None:
    """Of 100 keyframes, all but the first five see more than few of what lies on disk; the others come after them."""
    found = sweeps([10] * 5 + [11] * 95 + [0] * 200)
    assert list(found) == [64, 96, 128, 160, 193, 242]
    assert found[160] == [*range(5), *range(100, 160)]


def test_at_a_place_apart_its_own_keyframes_are_swept() -> None:
    """Nothing lies on disk: what the others see is in memory, as it is in a large pool."""
    found = sweeps([0] * 300, apart=150)
    assert list(found) == [64, 96, 144, 216, 249, 299]
    assert found[144] == list(range(144))
    assert found[249] == list(range(150, 249))


def test_what_a_keyframe_that_is_left_out_has_placed_stays(taichi_on_the_cpu: None) -> None:
    initialise("cpu")
    mapper = OnlineMapper(SETTINGS, 64, 48, seed=1, pace=Sweeping(0))
    for i in range(13):
        mapper.process(frame(i))
    first, second = [mapper.densifier.first_anchor_since(mapper.keyframes[i]) for i in range(2)]
    add_behind(mapper, 100.0, anchor=first)
    add_behind(mapper, 200.0, anchor=second)
    mapper.paging.away.missing[mapper.keyframes[0].index] = mapper.paging.most_missing + 1
    mapper.hidden.due = len(mapper.keyframes.selected)
    mapper.hidden.sweep_when_due(mapper.near)
    assert [count_behind(mapper, 100.0), count_behind(mapper, 200.0)] == [5, 0]


@pytest.fixture
def mapper(taichi_on_the_cpu: None) -> OnlineMapper:
    initialise("cpu")
    return two_walls()


def test_views_of_a_place_leave_the_gaussians_of_others(mapper: OnlineMapper) -> None:
    first, second, strangers, without_anchor = shares(mapper, [2, 3])
    assert first == strangers == 0.0
    assert min(second, without_anchor) > 0.5


def test_at_their_own_place_the_same_gaussians_are_optimised(mapper: OnlineMapper) -> None:
    first, second, *_ = shares(mapper, [0, 1])
    assert first > 0.5
    assert second == 0.0


def test_a_step_on_views_of_both_places_optimises_both(mapper: OnlineMapper) -> None:
    mapper.optimiser.settings = mapper.settings.model_copy(
        update={"optimise": mapper.settings.optimise.model_copy(update={"batch": 2})}
    )
    assert min(shares(mapper, [1, 2])) > 0.5


@pytest.mark.parametrize(("apart", "largest"), [(True, 0.8), (False, 2.0)])
def test_no_gaussian_reaches_from_one_place_to_the_next(mapper: OnlineMapper, apart: bool, largest: float) -> None:
    mapper.keyframes.begins = {2} if apart else set()
    depth, state, anchor = mapper.keyframes.scene_depth, mapper.gaussians.to_numpy(), mapper.gaussians.anchors()
    giants = np.arange(len(mapper.gaussians)) % 7 == 0
    state["log_scale"][giants, 1] = np.log(2.0 * depth)
    mapper.gaussians.load(state | {"anchor": anchor})
    seen = giants & changed(mapper, [2, 3])
    # Those that the views must not change otherwise are among them.
    assert (seen & (anchor == 0)).any()
    assert (seen & (anchor == 2)).any()
    sizes = np.exp(mapper.gaussians.to_numpy()["log_scale"].max(axis=1)) / depth
    assert sizes.max() == pytest.approx(largest, rel=0.1)


def test_back_at_a_place_later_views_optimise_what_the_first_ones_placed(mapper: OnlineMapper) -> None:
    mapper.process(frame(4))
    first = mapper.gaussians.anchors() == 0
    assert changed(mapper, [4])[first & (mapper.gaussians.to_numpy()["position"][:, 1] < APART[1] / 2)].mean() > 0.5

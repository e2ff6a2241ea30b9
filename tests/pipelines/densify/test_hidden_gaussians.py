"""Gaussians that hardly show are removed while the map grows."""

from __future__ import annotations

from fields.runtime.backend import initialise
from pipelines.online import OnlineMapper
from pipelines.pace import CompletePace, Plan
from pipelines.settings import MappingSettings
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


def test_a_map_is_never_swept_where_the_settings_say_so(taichi_on_the_cpu: None) -> None:
    initialise("cpu")
    settings = SETTINGS.model_copy(update={"densify": SETTINGS.densify.model_copy(update={"min_contribution": 0.0})})
    mapper = OnlineMapper(settings, 64, 48, seed=1, pace=Sweeping(9))
    for i in range(2):
        mapper.process(frame(i))
    add_behind(mapper, 100.0)
    renders = mapper.renderer.view_renders
    mapper.process(frame(2))
    assert count_behind(mapper, 100.0) == 5
    assert mapper.renderer.view_renders - renders <= 1 + SETTINGS.views.per_step

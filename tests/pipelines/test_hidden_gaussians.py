"""Gaussians that hardly show are removed while the map grows."""

from __future__ import annotations

from fields.runtime.backend import initialise
from pipelines.online import OnlineMapper
from pipelines.pace import CompletePace, Plan
from pipelines.settings import MappingSettings
from tests.pipelines.wall import frame

SETTINGS = MappingSettings(densify={"warm_up": 2})


def test_mapping_removes_what_hardly_shows_unless_it_is_young(taichi_on_the_cpu: None) -> None:
    class Removing(CompletePace):
        def plan(self, level: int, keyframes: int, frames: int) -> Plan:
            return Plan(0.0, 1, removes_hidden=keyframes == 3)

    initialise("cpu")
    mapper = OnlineMapper(SETTINGS, 64, 48, seed=1, pace=Removing(SETTINGS))
    for i in range(2):
        mapper.process(frame(i))
    behind = {name: values[:5].copy() for name, values in mapper.gaussians.to_numpy().items()}
    behind["position"] -= [0.0, 0.0, 100.0]
    mapper.gaussians.append(**behind)
    behind["position"] -= [0.0, 0.0, 100.0]
    mapper.gaussians.append(**behind, anchor=0)  # placed in a keyframe, of which there are few
    mapper.process(frame(2))
    depth = mapper.gaussians.to_numpy()["position"][:, 2]
    assert [(depth < -150).sum(), ((-150 < depth) & (depth < -50)).sum()] == [5, 0]
    assert (depth > 0).sum() >= 3 * 100  # nothing was lost that shows

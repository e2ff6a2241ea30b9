"""Maps of the wall: a mapper that has seen nothing, one that has finished, and what a finished run keeps of it."""

from __future__ import annotations

from dataclasses import replace

from fields.runtime.backend import initialise
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from pipelines.whole.finished_map import FinishedMap
from tests.pipelines.test_online import SETTINGS
from tests.pipelines.wall import frame


def fresh_mapper(settings: MappingSettings = SETTINGS, seed: int = 1, size: tuple[int, int] = (64, 48)) -> OnlineMapper:
    initialise("cpu")  # a process has room for one map
    return OnlineMapper(settings, *size, seed=seed)


def finished_mapper(frames: int) -> OnlineMapper:
    mapper = fresh_mapper()
    for i in range(frames):
        mapper.process(frame(i))
    mapper.finish()
    return mapper


def finished_map(mapper: OnlineMapper) -> FinishedMap:
    store = mapper.keyframes
    frames = [replace(frame(i), T_camera_world=store.corrected(i, T)) for i, T in mapper.trajectory.items()]
    keyframes = [view.index for view in store.selected]
    return FinishedMap(mapper.gaussians.to_numpy(), frames, keyframes, {}, store.scene_depth)

"""Views of a place apart leave the Gaussians of other places as they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fields.frames.tracked_frame import TrackedFrame
from fields.runtime.backend import initialise
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from tests.pipelines.wall import frame

# Between the walls, whose depth is about 4. Beyond three scene depths, a keyframe is of another place.
APART = np.array([0.0, 100.0, 0.0])


def moved(of: TrackedFrame, shift: np.ndarray) -> TrackedFrame:
    T = of.T_camera_world.copy()
    T[:3, 3] -= T[:3, :3] @ shift
    return replace(of, T_camera_world=T, points=replace(of.points, xyz=of.points.xyz + shift))


@pytest.fixture
def mapper(taichi_on_the_cpu: None) -> OnlineMapper:
    """A map of a wall in keyframes 0 and 1, and of a copy far away in 2 and 3, which see strangers of the first."""
    initialise("cpu")
    settings = MappingSettings(densify={"warm_up": 2}, keyframes={"max_gap": 1}, gate={"enabled": False})
    mapper = OnlineMapper(settings, 64, 48, seed=1)
    for i in range(4):
        mapper.process(moved(frame(i), APART * (i >= 2)))
    assert len(mapper.keyframes) == 4
    mapper.keyframes[2].begins_place = True
    strangers = {name: values[:40].copy() for name, values in mapper.gaussians.to_numpy().items()}
    strangers["position"] += APART - [0.0, 0.0, 0.5]
    mapper.gaussians.append(**strangers, anchor=0)
    mapper.gaussians.append(**strangers)
    return mapper


def changed(mapper: OnlineMapper, views: list[int]) -> np.ndarray:
    """Which Gaussians a step on these views changes, in their values or in the state of their optimiser."""

    def state() -> list[np.ndarray]:
        everything = mapper.gaussians.to_numpy() | mapper.gaussians.history()
        return [values.reshape(len(values), -1) for values in everything.values()]

    before = state()
    mapper.optimiser.step(mapper.keyframes, views, mapper.optimiser.rates(mapper.keyframes.scene_depth), pose_rate=0.0)
    mapper.optimiser.settle()
    return np.any([(a != b).any(axis=1) for a, b in zip(before, state(), strict=True)], axis=0)


def shares(mapper: OnlineMapper, views: list[int]) -> list[float]:
    """Shares that a step changes: of the first wall, the second one, strangers, and strangers without an anchor."""
    at = changed(mapper, views)
    there = mapper.gaussians.to_numpy()["position"][:, 1] > APART[1] / 2
    strangers = np.arange(len(at)) >= len(at) - 80
    anchored = mapper.gaussians.anchors() >= 0
    groups = (~there, there & ~strangers, strangers & anchored, strangers & ~anchored)
    return [float(at[group].mean()) for group in groups]


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


def test_in_a_map_of_one_place_nothing_is_held(mapper: OnlineMapper) -> None:
    mapper.keyframes[2].begins_place = False
    _, second, strangers, without_anchor = shares(mapper, [2, 3])
    assert min(second, strangers, without_anchor) > 0.5


def test_back_at_a_place_later_views_optimise_what_the_first_ones_placed(mapper: OnlineMapper) -> None:
    mapper.process(frame(4))
    first = mapper.gaussians.anchors() == 0
    assert changed(mapper, [4])[first & (mapper.gaussians.to_numpy()["position"][:, 1] < APART[1] / 2)].mean() > 0.5

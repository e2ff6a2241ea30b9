"""A map of two walls at places apart, where Gaussians of the first place show in the views of the second."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from tests.pipelines.wall import frame

# Between the walls, whose depth is about 4. Beyond three scene depths, a keyframe is of another place.
APART = np.array([0.0, 100.0, 0.0])
# Of the Gaussians, the last ones stand before the second wall, but were placed by the first keyframe or by none.
STRANGERS = 40


def moved(of: TrackedFrame, shift: NDArray[np.float64]) -> TrackedFrame:
    T = of.T_camera_world.copy()
    T[:3, 3] -= T[:3, :3] @ shift
    return replace(of, T_camera_world=T, points=replace(of.points, xyz=of.points.xyz + shift))


def two_walls() -> OnlineMapper:
    """A map of a wall in keyframes 0 and 1, and of a copy far away in 2 and 3, which see strangers of the first."""
    # A step of the GPU's stand-in takes a second.
    settings = MappingSettings(
        optimise={"steps": 1}, densify={"warm_up": 2}, keyframes={"max_gap": 1}, gate={"enabled": False}
    )
    mapper = OnlineMapper(settings, 64, 48, seed=1)
    mapper.compile()
    for i in range(4):
        mapper.process(moved(frame(i), APART * (i >= 2)))
    assert len(mapper.keyframes) == 4
    mapper.keyframes.begins.add(mapper.keyframes[2].index)
    strangers = {name: values[:STRANGERS].copy() for name, values in mapper.gaussians.to_numpy().items()}
    strangers["position"] += APART - [0.0, 0.0, 0.5]
    mapper.gaussians.append(**strangers, anchor=0)
    mapper.gaussians.append(**strangers)
    return mapper


def changed(mapper: OnlineMapper, views: list[int]) -> NDArray[np.bool_]:
    """Which Gaussians a step on these views changes, in their values or in the state of their optimiser."""

    def state() -> list[NDArray]:
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
    strangers = np.arange(len(at)) >= len(at) - 2 * STRANGERS
    anchored = mapper.gaussians.anchors() >= 0
    groups = (~there, there & ~strangers, strangers & anchored, strangers & ~anchored)
    return [float(at[group].mean()) for group in groups]

"""`merge`: the maps of overlapping parts of a recording become one online map."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from pipelines.finished_map import FinishedMap, take_in_frames, take_in_gaussians
from pipelines.merging.free_space import FreeSpace, ShownSurface
from pipelines.merging.gauge import colour_changes, exposed_in, recoloured
from pipelines.merging.ownership import Shown, owned
from pipelines.online_map import OnlineMap
from pipelines.render.cpu.photometric_model import IDENTITY

__all__ = ["MappedPart", "merge"]

# Edge of the cubes in which the maps compete for space [scene depths].
EDGE = 1 / 16
# Pyramid level at which it is measured how much of each Gaussian shows, which takes half as long as at the full size.
COARSE = 1
# How often Gaussians that float in free space are looked for. What they hid, and what the next owner of their place has
# there, may float as well: 654 and 148 Gaussians of four parts with 79,497. A third time finds 23.
ROUNDS = 2


@dataclass(frozen=True)
class MappedPart:
    """What the run of a part keeps of its map. Frames are named by their indices in the whole recording.

    Attributes:
        own: The frames that belong to this part. Its other frames belong to the parts before and after it.
        gaussians: The Gaussians, as from `GaussianField.to_numpy`.
        keyframes: The keyframes.
        poses: Refined T_camera_world (4, 4) of each frame.
        exposures: Exposure (3, 4) of each frame; empty if none was estimated.
        scene_depth: Depth of keyframes without tracked points [scene units].
        view_renders: Number of views that were rendered and differentiated to make the map.
    """

    own: range
    gaussians: Mapping[str, NDArray]
    keyframes: Sequence[int]
    poses: Mapping[int, NDArray[np.float64]]
    exposures: Mapping[int, NDArray[np.float64]]
    scene_depth: float
    view_renders: int


def merge(mapper: OnlineMap, parts: Sequence[MappedPart], frames: Iterable[TrackedFrame]) -> list[int]:
    """Put the maps of the parts of a recording into a new online map.

    Every frame has the pose and the exposure that the part has found that it belongs to, and every Gaussian comes from
    the part that owns its place, see `pipelines.merging.ownership`. What floats where another part sees free space is
    left out, see `pipelines.merging.free_space`.

    Args:
        mapper: The new map, without frames.
        parts: The parts, in order. Each frame belongs to one of them.
        frames: All frames of the recording in order, with their tracked poses. They are iterated over once.

    Returns:
        The number of Gaussians that are left of each part.

    Raises:
        ValueError: If the Gaussians do not fit the settings, or none of the keyframes is among the frames.
    """
    parts = _in_one_gauge(parts)
    mapper.renderer.view_renders += sum(part.view_renders for part in parts)
    take_in_frames(mapper, _finished(parts, frames))
    kept = _kept(mapper, parts)
    take_in_gaussians(mapper, _together(parts, kept))
    return [int(own.sum()) for own in kept]


def _kept(mapper: OnlineMap, parts: Sequence[MappedPart]) -> list[NDArray[np.bool_]]:
    """Return which Gaussians (N,) of each part are kept: what it owns, and no keyframe of another part sees through."""
    space, contribution = FreeSpace(mapper.renderer, mapper.near), mapper.hidden.contribution
    shown: list[Shown] = []
    views: list[ShownSurface] = []
    for number, part in enumerate(parts):
        mapper.gaussians.load(dict(part.gaussians))
        contribution.begin()
        for view in mapper.keyframes:
            if view.index in part.own:
                contribution.measure([view], mapper.near, COARSE)
                views.append(space.surface(number, view.image(COARSE).camera, view.T_camera_world))
        shown.append(Shown(part.gaussians["position"].astype(np.float64), mapper.gaussians.coverages()))
    numbers = np.repeat(np.arange(len(parts)), [len(each.position) for each in shown])
    ends = np.cumsum([len(each.position) for each in shown])[:-1]
    floating = np.zeros(len(numbers), dtype=np.bool_)
    for _ in range(ROUNDS):
        kept = owned(shown, EDGE * mapper.keyframes.scene_depth)
        mapper.gaussians.load(_together(parts, kept))
        places = np.flatnonzero(np.concatenate(kept))
        floating[places] = space.floating(numbers[places], views)
        shown = [
            replace(each, coverage=np.where(floats, 0.0, each.coverage))
            for each, floats in zip(shown, np.split(floating, ends), strict=True)
        ]
    return owned(shown, EDGE * mapper.keyframes.scene_depth)


def _together(parts: Sequence[MappedPart], kept: Sequence[NDArray[np.bool_]]) -> dict[str, NDArray]:
    """Return the Gaussians that are kept of all parts."""
    return {
        name: np.concatenate([part.gaussians[name][own] for part, own in zip(parts, kept, strict=True)])
        for name in parts[0].gaussians
    }


def _finished(parts: Sequence[MappedPart], frames: Iterable[TrackedFrame]) -> FinishedMap:
    """Return the merged map without Gaussians: what each part knows of its own frames."""
    return FinishedMap(
        {},
        frames,
        {index for part in parts for index in part.keyframes if index in part.own},
        {index: part.exposures[index] for part in parts for index in part.own if index in part.exposures},
        float(np.median([part.scene_depth for part in parts])),
        {index: part.poses[index] for part in parts for index in part.own},
    )


def _in_one_gauge(parts: Sequence[MappedPart]) -> list[MappedPart]:
    """Return the parts with the colours of the first one. Without any exposures, they stay as they are."""
    if not any(part.exposures for part in parts):
        return list(parts)
    exposures = [{i: part.exposures.get(i, np.array(IDENTITY)) for i in part.poses} for part in parts]
    return [
        replace(
            part,
            gaussians={**part.gaussians, "sh": recoloured(part.gaussians["sh"], change)},
            exposures={i: exposed_in(exposure, change) for i, exposure in own.items()},
        )
        for part, own, change in zip(parts, exposures, colour_changes(exposures), strict=True)
    ]

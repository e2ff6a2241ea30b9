"""`MapState`: the state of an online map between two steps as plain arrays and numbers, saved and restored."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeRows, keyframe_arrays
from pipelines.densify.densifier import Anchor
from pipelines.online import OnlineMapper

# Number of keyframes whose images go to disk together, in one file, while they are read again.
STORED_TOGETHER = 16


@dataclass(frozen=True)
class MapState:
    """State of a mapper between two steps.

    Attributes:
        arrays: Arrays, by `group.name`.
        numbers: JSON-compatible values.
    """

    arrays: dict[str, NDArray]
    numbers: dict[str, Any]

    @classmethod
    def of(cls, groups: Mapping[str, Mapping[str, NDArray]], numbers: Mapping[str, Any]) -> MapState:
        """Build a state from groups of arrays and from numbers."""
        arrays = {f"{group}.{name}": array for group, of in groups.items() for name, array in of.items()}
        return cls(arrays, dict(numbers))

    def group(self, group: str) -> dict[str, NDArray]:
        """Return the arrays of a group by name; empty if there is no such group."""
        start = group + "."
        return {name[len(start) :]: array for name, array in self.arrays.items() if name.startswith(start)}


class Saved(Protocol):
    """What saves its own tables by keyframe."""

    def state(self) -> dict[str, NDArray]: ...

    def restore(self, state: Mapping[str, NDArray], /) -> None: ...


def _tables(mapper: OnlineMapper) -> dict[str, Saved]:
    """What keeps tables of frames or keyframes, by the name of their group."""
    optimiser = mapper.optimiser
    return {
        "tracked": mapper.trajectory,
        "poses": optimiser.poses.moments,
        "exposures": optimiser.exposure.moments,
        "corrections": mapper.corrector,
    }


def save_state(mapper: OnlineMapper) -> MapState:
    """Return everything that the next frame or step depends on, except the keyframes' images.

    Call it between two steps.
    """
    mapper.optimiser.settle()
    anchors, voxels = mapper.densifier.anchors, mapper.densifier.voxels
    place = {view.index: row for row, view in enumerate(mapper.keyframes)}
    groups = {
        "gaussians": mapper.gaussians.to_numpy() | mapper.gaussians.history(),
        "keyframes": keyframe_arrays(mapper.keyframes),
        **{group: table.state() for group, table in _tables(mapper).items()},
        "anchors": {
            "keyframe": np.array([place[anchor.keyframe.index] for anchor in anchors], dtype=np.int64),
            "spacing": np.array([anchor.spacing for anchor in anchors]),
        },
    }
    numbers: dict[str, Any] = {
        "frames": mapper.frame_count,
        "places": sorted(mapper.keyframes.begins),
        "settled": mapper.settled,
        "sweep_due": mapper.hidden.due,
        "view_renders": mapper.renderer.view_renders,
        "random": mapper.rng.bit_generator.state,
        "gate": mapper.gate.state(),
        "guards": mapper.caught().counts(),
    }
    if voxels is not None:
        groups["voxels"] = dict(zip(("places", "words", "resting"), voxels.marks(), strict=True))
        numbers |= {"coarsest": voxels.coarsest, "origin": voxels.origin.tolist()}
    if len(mapper.paging.away):
        groups["blocks"] = mapper.paging.away.state()
        numbers["most_missing"] = mapper.paging.most_missing
    if mapper.settled:
        groups["settling"] = {"group": mapper.paging.group}
    if mapper.selector.previous is not None:
        groups["previous"] = {"index": np.array(mapper.selector.previous)}
    return MapState.of(groups, numbers)


def restore_state(mapper: OnlineMapper, state: MapState, frames: Iterable[TrackedFrame]) -> None:
    """Restore a saved state into a new map with the same settings.

    Args:
        mapper: The new map.
        state: Result of `save_state`.
        frames: The frames that the saved map had processed, without held-out ones. The keyframes take their images
            from them.

    Raises:
        KeyError, ValueError: If the state is of another map, or not complete. The map is then unusable.
    """
    for group, table in _tables(mapper).items():
        table.restore(state.group(group))
    rows = KeyframeRows(state.group("keyframes"))
    blocks = state.group("blocks")
    on_disk = set(blocks["images"].tolist()) if blocks else ()
    read: list[Keyframe] = []  # images that go to disk
    for frame in frames:
        if frame.index in rows.rows:
            rows.put(frame, mapper.keyframes)
            if frame.index in on_disk:
                read.append(mapper.keyframes[-1])
        if len(read) == STORED_TOGETHER:
            mapper.paging.away.store_keyframes(read)
            read = []
    mapper.paging.away.store_keyframes(read)
    if len(mapper.keyframes) != len(rows.rows):
        raise ValueError(f"{len(mapper.keyframes)} of the {len(rows.rows)} keyframes are among the frames")
    mapper.keyframes.take_in_depths()
    mapper.keyframes.begins = set(state.numbers["places"])
    mapper.gaussians.restore(state.group("gaussians"))
    if blocks:
        mapper.paging.away.restore(blocks)
        mapper.paging.most_missing = int(state.numbers["most_missing"])
    if settling := state.group("settling"):
        mapper.paging.group = settling["group"]
    anchors = state.group("anchors")
    pairs = zip(anchors["keyframe"].tolist(), anchors["spacing"].tolist(), strict=True)
    mapper.densifier.anchors = [Anchor(mapper.keyframes[row], spacing) for row, spacing in pairs]
    if mapper.densifier.voxels is not None:
        coarsest, origin = state.numbers["coarsest"], np.array(state.numbers["origin"])
        mapper.densifier.voxels.settle(coarsest, origin)
        mapper.densifier.voxels.restore(**state.group("voxels"))
    previous = state.group("previous")
    mapper.selector.previous = int(previous["index"]) if previous else None
    mapper.frame_count = int(state.numbers["frames"])
    mapper.settled = int(state.numbers["settled"])
    mapper.hidden.due = int(state.numbers["sweep_due"])
    mapper.renderer.view_renders = int(state.numbers["view_renders"])
    mapper.rng.bit_generator.state = state.numbers["random"]
    mapper.gate.restore(state.numbers["gate"])
    mapper.optimiser.safeguards.restore(state.numbers["guards"])

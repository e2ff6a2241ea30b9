"""`Trajectory`: the tracked poses of all frames of a map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame


class Trajectory(Mapping[int, NDArray[np.float64]]):
    """Tracked poses T_camera_world (4, 4) by frame index, with all corrections of the tracker so far.

    It contains every frame that the tracker delivered, in order, and is the only owner of these poses. Objects that
    need the pose of a frame keep its index and look the pose up here. Poses are replaced and never modified in place.

    Attributes:
        held_out: Indices of the frames that are for evaluation only, and must not move the map.
    """

    def __init__(self) -> None:
        self._poses: dict[int, NDArray[np.float64]] = {}
        self.held_out: set[int] = set()

    def __getitem__(self, index: int) -> NDArray[np.float64]:
        return self._poses[index]

    def __iter__(self) -> Iterator[int]:
        return iter(self._poses)

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, frame: TrackedFrame) -> None:
        """Add a frame. One that was added before keeps its pose, which may have been revised since."""
        self._poses.setdefault(frame.index, frame.T_camera_world)
        if frame.held_out:
            self.held_out.add(frame.index)

    def revise(self, revised: Mapping[int, NDArray[np.float64]]) -> None:
        """Replace poses by those that the tracker revised. Frames that have not been added are ignored."""
        self._poses |= {index: T for index, T in revised.items() if index in self._poses}

    def state(self) -> dict[str, NDArray]:
        """Return the frames' indices (N,) as `index`, their poses (N, 4, 4) as `T`, and `held_out` (N,)."""
        return {
            "index": np.array(list(self._poses), dtype=np.int64),
            "T": np.array(list(self._poses.values())).reshape(-1, 4, 4),
            "held_out": np.array([index in self.held_out for index in self._poses], dtype=bool),
        }

    def restore(self, state: Mapping[str, NDArray]) -> None:
        """Restore the result of `state`."""
        self._poses = dict(zip(state["index"].tolist(), list(state["T"]), strict=True))
        self.held_out = {i for i, apart in zip(self._poses, state["held_out"].tolist(), strict=True) if apart}

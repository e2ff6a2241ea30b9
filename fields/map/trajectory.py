"""`Trajectory`: the tracked poses of all frames of a map."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame

__all__ = ["Trajectory"]


class Trajectory(Mapping[int, NDArray[np.float64]]):
    """Tracked poses T_camera_world (4, 4) by frame index, with all corrections of the tracker so far.

    It contains every frame that was processed, held-out frames excepted. Objects that need the pose of an earlier frame
    keep its index and look the pose up here. Poses are replaced and never modified in place.
    """

    def __init__(self) -> None:
        self._poses: dict[int, NDArray[np.float64]] = {}

    def __getitem__(self, index: int) -> NDArray[np.float64]:
        return self._poses[index]

    def __iter__(self) -> Iterator[int]:
        return iter(self._poses)

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, frame: TrackedFrame) -> None:
        """Add the tracked pose of a frame."""
        self._poses[frame.index] = frame.T_camera_world

    def revise(self, revised: Callable[[int, NDArray[np.float64]], NDArray[np.float64]]) -> None:
        """Replace the pose of every frame by `revised(index, pose)`."""
        self._poses = {index: revised(index, T) for index, T in self._poses.items()}

    def state(self) -> dict[str, NDArray]:
        """Return the frames' indices (N,) as `index` and their poses (N, 4, 4) as `T`."""
        return {
            "index": np.array(list(self._poses), dtype=np.int64),
            "T": np.array(list(self._poses.values())).reshape(-1, 4, 4),
        }

    def restore(self, state: Mapping[str, NDArray]) -> None:
        """Restore the result of `state`.

        Raises:
            KeyError: If an array is missing.
            ValueError: If the arrays differ in length.
        """
        self._poses = dict(zip(state["index"].tolist(), list(state["T"]), strict=True))

"""`JoinedTracker`: a tracker whose frames follow those of an earlier map, in the world of that map."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.se3 import moved_points, moved_pose
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.protocol import Before, Event, Tracker

if TYPE_CHECKING:
    from modp_ti.inputs.sources import Picture, Undistorter

# Time between the last frame of the earlier map and the first new one, where the new times are not later anyway [s].
GAP = 1.0


class EarlierFrames(Protocol):
    """The frames of the earlier map, in its world."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[TrackedFrame]: ...

    def pictures(self, names: Sequence[str]) -> Iterator[tuple[str, Picture]]: ...

    @property
    def size(self) -> tuple[int, int]: ...

    @property
    def end(self) -> float: ...


@dataclass(frozen=True)
class Placement:
    """How the frames of a tracker become frames that follow others.

    Attributes:
        S_map_tracker: Similarity (4, 4) from the tracker's world to that of the map.
        first: Index of the tracker's first frame.
        shift: Added to its times [s].
        prefix: Put before the names of its images.
    """

    S_map_tracker: NDArray[np.float64]
    first: int
    shift: float
    prefix: str

    def frame(self, frame: TrackedFrame) -> TrackedFrame:
        """Return a frame of the tracker as it follows the others."""
        points = replace(frame.points, xyz=moved_points(self.S_map_tracker, frame.points.xyz))
        return replace(
            frame,
            index=frame.index + self.first,
            timestamp=frame.timestamp + self.shift,
            name=f"{self.prefix}{frame.name}",
            T_camera_world=moved_pose(self.S_map_tracker, frame.T_camera_world),
            points=points,
        )

    def correction(self, correction: PoseCorrection) -> PoseCorrection:
        """Return a correction of the tracker for its frames here. Frames that it does not list keep their poses.

        Raises:
            InputError: If it revises the camera, which would be that of the earlier frames too.
        """
        if correction.camera is not None:
            raise InputError("`onto` needs a camera that does not change: give source.intrinsics")
        return replace(
            correction,
            index=correction.index + self.first,
            T_camera_world=np.stack([moved_pose(self.S_map_tracker, T) for T in correction.T_camera_world]),
            xyz=moved_points(self.S_map_tracker, correction.xyz),
            others_stay=True,
        )


class JoinedTracker(Tracker):
    """Delivers the frames of an earlier map, and then those of a tracker in the world of that map.

    The tracker must be one that reads ahead, as all are that follow no clock.

    Args:
        earlier: The frames of the earlier map.
        tracker: The tracker of the new frames.
        placement: Their place in the map.
        taken: Frames and corrections that were taken from the tracker before.
        rest: Those that are still to come.
    """

    reads_ahead: ClassVar[bool] = True
    corrects: ClassVar[bool] = True

    def __init__(
        self,
        earlier: EarlierFrames,
        tracker: Tracker,
        placement: Placement,
        taken: Sequence[Event],
        rest: Iterator[Event],
    ) -> None:
        self._earlier = earlier
        self._tracker = tracker
        self._placement = placement
        self._taken = list(taken)
        self._rest = rest

    @property
    def before(self) -> Before:
        return Before(len(self._earlier), *self._earlier.size, self._placement.shift)

    @property
    def notes(self) -> list[str]:
        return self._tracker.notes

    def __iter__(self) -> Iterator[Event]:
        """Iterate once over the earlier frames, and over the new frames and their corrections."""
        yield from self._earlier
        while self._taken:  # the waiting images are released one by one
            yield self._placed(self._taken.pop(0))
        yield from map(self._placed, self._rest)

    def pictures(self, names: Sequence[str]) -> Iterator[tuple[str, Picture]]:
        prefix = self._placement.prefix
        own = [name.removeprefix(prefix) for name in names if name.startswith(prefix)]
        yield from self._earlier.pictures([name for name in names if not name.startswith(prefix)])
        yield from ((f"{prefix}{name}", picture) for name, picture in self._tracker.pictures(own))

    def _placed(self, event: Event) -> Event:
        return self._placement.frame(event) if isinstance(event, TrackedFrame) else self._placement.correction(event)

    @property
    def frame_count(self) -> int | None:
        count = self._tracker.frame_count
        return None if count is None else len(self._earlier) + count

    @property
    def scale(self) -> float:
        return self._tracker.scale

    @property
    def largest(self) -> tuple[int, int]:
        return self._tracker.largest

    @property
    def unreadable(self) -> Mapping[str, UnreadableImageError]:
        return self._tracker.unreadable

    @property
    def undistorter(self) -> Undistorter | None:
        """Undistorter of the new frames."""
        return self._tracker.undistorter


def shift_after(last: float, first: float) -> float:
    """Return what is added to the times of new frames, the first at `first`, so that they come after `last` [s]."""
    return 0.0 if first > last else last + GAP - first


def prefix_for(names: Iterable[str]) -> str:
    """Return the prefix of the names of the next visit to a map whose frames have these names: `visit2/`, ..."""
    visits = (re.match(r"visit([0-9]+)/", name) for name in names)
    return f"visit{max((int(visit[1]) for visit in visits if visit), default=1) + 1}/"

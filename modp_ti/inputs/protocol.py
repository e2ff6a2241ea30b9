"""The `Tracker` base class, and the counts of one that follows a clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.files.errors import InputError, UnreadableImageError

if TYPE_CHECKING:
    from modp_ti.inputs.replay import PosedImage
    from modp_ti.inputs.sources import Picture, Undistorter

Event = TrackedFrame | PoseCorrection
"""What a tracker delivers: the next frame, or a correction of earlier ones."""


class NothingPlacedError(InputError):
    """A tracker of bare images could place none of them. Another tracker may."""


Progress = Callable[[str, int, int], None]
"""Progress callback, called as progress(what, done, total) while a tracker prepares."""


@dataclass(frozen=True)
class Before:
    """What comes before the frames of a tracker.

    Attributes:
        frames: Number of frames of an earlier map that come first.
        width: Largest width of their images [px].
        height: Largest height of their images [px].
        shift: Added to the times of the tracker's own frames, so that they are later [s].
    """

    frames: int = 0
    width: int = 0
    height: int = 0
    shift: float = 0.0


@dataclass(frozen=True)
class LiveCounts:
    """What a tracker that follows a clock has done so far.

    Attributes:
        arrived: Number of frames received.
        tracked: Number of frames that were given a pose.
        thinned: Number of frames that were left out evenly before tracking.
        lost: Number of frames that the tracker could not place.
        waiting: Number of frames that wait for the mapper now.
        newest: `time.monotonic()` when the newest frame was received [s].
    """

    arrived: int
    tracked: int
    thinned: int
    lost: int
    waiting: int
    newest: float


class Tracker(ABC):
    """Base class of trackers: delivers frames in order and decodes each one on demand.

    Subclasses must implement `notes`, `__iter__` and `pictures`. Every other member has a default. For example, a
    tracker that holds a camera or a socket open overrides `close`. Callers use this interface only.
    """

    reads_ahead: ClassVar[bool] = False
    """Whether a second thread may iterate over the tracker while the mapper runs. Such a tracker must not launch
    Taichi kernels, because only one thread may do so."""

    corrects: ClassVar[bool] = False
    """Whether corrections of earlier frames may come between the frames."""

    frames: Sequence[PosedImage] = ()
    """The images with their poses and points in order, of a tracker that has all of them once it is open."""

    @property
    @abstractmethod
    def notes(self) -> list[str]:
        """One-line remarks for the user, such as how many frames were skipped.

        They are available once the tracker is open. More may be added by the time the last frame has been delivered.
        """

    @abstractmethod
    def __iter__(self) -> Iterator[Event]:
        """Iterate once over the frames in order, and over corrections of earlier ones between them.

        Raises:
            InputError: If the input is invalid.
        """

    @abstractmethod
    def pictures(self, names: Sequence[str]) -> Iterator[tuple[str, Picture]]:
        """Read images of delivered frames again, as frames delivered after the last event would show them.

        Args:
            names: Names of the frames, in the order in which they were delivered.

        Yields:
            Name and picture of each frame whose image can still be read, in order.
        """

    @property
    def frame_count(self) -> int | None:
        """Number of frames that the tracker delivers, or None if it is unknown, as for a live camera.

        It may shrink while the tracker finds images that it cannot place.
        """
        return None

    @property
    def unplaced(self) -> int:
        """Number of images so far that a tracker of bare images could not place."""
        return 0

    @property
    def scale(self) -> float:
        """Factor from the width and height of the stored images to those of the delivered ones."""
        return 1.0

    @property
    def unreadable(self) -> Mapping[str, UnreadableImageError]:
        """Damaged images skipped so far, by name, with the error for each."""
        return {}

    @property
    def undistorter(self) -> Undistorter | None:
        """Undistorter of the first frame's image, or None if the tracker does not provide one."""
        return None

    @property
    def largest(self) -> tuple[int, int]:
        """Largest width and height of the delivered images, as far as they are known; 0 otherwise."""
        return 0, 0

    @property
    def origin(self) -> NDArray[np.float64] | None:
        """Origin of a map of a world that is far away (3,), as `far_origin`; None to let the first frame decide."""
        return None

    @property
    def further_maps(self) -> int:
        """Number of other maps that the tracker made of the images, which are mapped in runs of their own."""
        return 0

    @property
    def before(self) -> Before:
        """What comes before the tracker's own frames; nothing, but on a second visit to a map."""
        return Before()

    @property
    def live(self) -> LiveCounts | None:
        """What a tracker that follows a clock has done so far; None for other trackers."""
        return None

    @property
    def kept(self) -> Mapping[str, Mapping[str, str | None]]:
        """Settings, by section, that read again what a live tracker keeps until `close`; empty for other trackers."""
        return {}

    def sampled(self, apart: int, each: int, blocks: int) -> Iterator[tuple[int, TrackedFrame]]:
        """Yield place and frame of some images of `frames`, but of damaged ones: of rigs the first view.

        Args:
            apart: Images from one to the next of a block, fewer in a short recording.
            each: Images of a block.
            blocks: Number of blocks, which are spread evenly.
        """
        return iter(())

    def within(self, first: int, end: int) -> Tracker:
        """Deliver only those of `frames` at the positions from `first` to before `end`, and return this tracker.

        Their indices count from 0. The same frames are held out as in the whole recording.

        Raises:
            InputError: If the recording has no such frames.
        """
        raise InputError("source.part needs a tracker with given poses")

    def close(self) -> None:  # noqa: B027 - most trackers hold nothing open
        """Release open resources, such as a camera, a file or a socket."""

"""What a tracker is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.files.errors import UnreadableImageError

if TYPE_CHECKING:
    from modp_ti.inputs.sources import Undistorter

__all__ = ["Progress", "Tracker"]

Progress = Callable[[str, int, int], None]
"""Called as progress(what, done, total) while a tracker prepares."""


class Tracker(ABC):
    """Delivers frames in order, each decoded when it is asked for.

    Every tracker has `notes` and can be iterated over. What only some can do has a default here: a tracker that
    revises poses overrides `events`, one that holds a camera or a socket open overrides `close`, and so on. Whoever
    uses a tracker asks for nothing beyond this class.
    """

    reads_ahead: ClassVar[bool] = False
    """Whether a thread may iterate over the tracker beside the mapper. It must not start Taichi's kernels then, which
    one thread alone may do."""

    @property
    @abstractmethod
    def notes(self) -> list[str]:
        """One-line remarks for the user, known when the tracker is opened, such as frames that were skipped.

        A live tracker may have more of them once its frames have ended.
        """

    @abstractmethod
    def __iter__(self) -> Iterator[TrackedFrame]:
        """The frames in their order.

        Where poses were revised, these are the poses that the frames had last.

        Raises:
            InputError: Where an input turns out bad.
        """

    def events(self) -> Iterator[TrackedFrame | PoseCorrection]:
        """The frames and, between them, corrections of frames before; a live tracker delivers them once."""
        return iter(self)

    @property
    def frame_count(self) -> int | None:
        """How many frames the tracker delivers; None where it does not know, as with a live camera."""
        return None

    @property
    def unreadable(self) -> Mapping[str, UnreadableImageError]:
        """Images that were left out because they are damaged, with what is wrong, as far as they have been come to."""
        return {}

    @property
    def undistorter(self) -> Undistorter | None:
        """What frees the first frame's image from the distortion of its lens; None where the tracker does not say."""
        return None

    def ground_truth(self) -> list[NDArray[np.float64]]:
        """True T_camera_world (4, 4) of every frame, in metres; empty where it is not known."""
        return []

    def close(self) -> None:  # noqa: B027 - most trackers hold nothing open
        """Let go of what the tracker holds open: a camera, a file, a socket."""

"""What a tracker is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol, runtime_checkable

from fields.pose_correction import PoseCorrection
from fields.tracked_frame import TrackedFrame

__all__ = ["Progress", "Tracker", "close", "events", "frame_count", "may_read_ahead"]

Progress = Callable[[str, int, int], None]
"""Called as progress(what, done, total) while a tracker prepares."""


@runtime_checkable
class Tracker(Protocol):
    """Delivers frames in order, each decoded when it is asked for.

    notes: one-line remarks for the user, known when the tracker is opened, such as frames that were skipped; one that
    is live may have more of them once its frames have ended.
    A tracker that knows how many frames it will deliver has `__len__`. One whose frames may be read in a thread
    beside the mapper has `reads_ahead = True`; it must not start Taichi's kernels then, which one thread alone may do.
    A tracker that revises poses has `events()`, an iterator over its frames and, between them, `PoseCorrection`s of
    frames before. It may be live; the frames are there again, with the poses that they had last, when the tracker is
    iterated over afterwards. One that holds a camera or a socket open has `close()`.
    Iterating raises InputError where an input turns out bad.
    """

    @property
    def notes(self) -> list[str]: ...

    def __iter__(self) -> Iterator[TrackedFrame]: ...


def events(tracker: Tracker) -> Iterator[TrackedFrame | PoseCorrection]:
    """What the tracker delivers: its frames, and corrections where it makes any."""
    return tracker.events() if hasattr(tracker, "events") else iter(tracker)


def close(tracker: Tracker) -> None:
    """Let go of what the tracker holds open: a camera, a file, a socket."""
    if hasattr(tracker, "close"):
        tracker.close()


def frame_count(tracker: Tracker) -> int | None:
    """How many frames the tracker delivers; None where it does not know, as with a live camera."""
    return len(tracker) if hasattr(tracker, "__len__") else None


def may_read_ahead(tracker: Tracker) -> bool:
    """Whether a thread may iterate over the tracker while the mapper works; not unless it says so."""
    return getattr(tracker, "reads_ahead", False)

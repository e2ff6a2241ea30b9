"""The stream of a run: read ahead by a thread, taken to the mapper by a `Conductor`, and seen by an `Observer`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from queue import SimpleQueue
from threading import Semaphore, Thread
from typing import Any, TypeVar

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.config.settings import SceneConfig, ViewSettings
from modp_ti.engine.interruption import Interruption
from modp_ti.engine.mapper import Mapper
from modp_ti.files.errors import InputError
from modp_ti.inputs.protocol import Event
from modp_ti.outputs.progress import LiveStatus
from pipelines.companions.pace import Pace
from pipelines.pipeline import FrameReport
from pipelines.refinement import Schedule, in_seconds
from pipelines.settings import RefineSettings

Item = TypeVar("Item", bound=TrackedFrame | PoseCorrection)


class FramesAhead(Iterator[Item]):
    """Iterator over `frames` that reads up to `ahead` of them in advance and builds their image pyramids.

    The order is kept. Pose corrections stay in their places between the frames, and each counts as one frame.

    A single thread reads. Taichi's kernels hold the GIL while they run. OpenCV and NumPy, which do nearly all of the
    decoding, undistortion and resizing, release it and therefore run in parallel. An error of `frames` is raised in its
    place, after all earlier frames.

    Use it as a context manager: on exit, the thread ends after the frame that it is reading.

    Args:
        frames: Frames and corrections of a tracker.
        ahead: Number of frames to read in advance. With 0, no thread is used.
        interrupt: Called on exit with an error, so that the thread does not wait for a frame that is still to come.
    """

    def __init__(self, frames: Iterable[Item], ahead: int, interrupt: Callable[[], None] | None = None) -> None:
        self._frames = iter(frames)
        self._interrupt = interrupt
        self._ready: SimpleQueue[Item | BaseException] = SimpleQueue()
        self._free = Semaphore(ahead)  # number of frames that may still be read ahead
        self._next: Item | BaseException | None = None  # taken from the queue already
        self._closed = False
        # A daemon thread, so that the process can exit even if this object was not closed. It only reads.
        self._thread = Thread(target=self._read, name="frames ahead", daemon=True) if ahead else None
        if self._thread is not None:
            self._thread.start()

    def __next__(self) -> Item:
        self._take(wait=True)
        item = self._next
        if isinstance(item, BaseException):
            raise item
        self._next = None
        assert item is not None, "`_take` has waited for it"
        return item

    @property
    def waiting(self) -> int:
        """Number of frames and corrections that the thread has read in advance. The end of `frames` counts as one."""
        return 0 if self._thread is None else self._ready.qsize() + (self._next is not None)

    def ready(self) -> bool:
        """Return whether the next frame, the end or an error is there already, so that `next` does not wait.

        Without a thread, frames are read on demand, so that the next one counts as there.
        """
        return self._thread is None or self.waiting > 0

    def peek(self, wait: bool = False) -> Item | None:
        """Return what comes next without taking it; None if it is the end or an error, or not there yet.

        Args:
            wait: Whether to wait until it is there.
        """
        self._take(wait)
        return None if isinstance(self._next, BaseException) else self._next

    def first_frame(self) -> TrackedFrame:
        """Wait for the first frame and return it; it stays the next one.

        Raises:
            InputError: If there is none, or a correction comes before it.
        """
        first = self.peek(wait=True)
        if isinstance(self._next, StopIteration):
            raise InputError("the tracker delivered no frame: nothing to map")
        if isinstance(self._next, BaseException):
            raise self._next
        if not isinstance(first, TrackedFrame):
            raise InputError("the tracker corrects poses before its first frame")
        return first

    def __enter__(self) -> FramesAhead[Item]:
        return self

    def __exit__(self, *error: object) -> None:
        if self._thread is not None:
            self._closed = True
            self._free.release()
            if error[0] is not None and self._interrupt is not None:
                self._interrupt()
            self._thread.join()

    def _take(self, wait: bool) -> None:
        """Take the next item, or the end or an error in its place, from the queue, if it is there."""
        if self._next is None and self._thread is None and wait:
            self._next = self._read_one()
        elif self._next is None and (wait or not self._ready.empty()):
            self._next = self._ready.get()
            self._free.release()

    def _read_one(self) -> Item | BaseException:
        try:
            return next(self._frames)
        except BaseException as error:  # includes StopIteration, so that the end comes after the last frame
            return error

    def _read(self) -> None:
        while True:
            self._free.acquire()
            if self._closed:
                return
            item = self._read_one()
            try:
                if isinstance(item, TrackedFrame):
                    _ = item.pyramid  # cached in the frame, for the mapper
            except BaseException as error:
                item = error
            self._ready.put(item)
            if isinstance(item, BaseException):
                return


class Conductor:
    """Takes frames and corrections to the mapper, each as soon as the mapper is done with the previous one.

    Args:
        pace: Pace of the mapper.

    Attributes:
        pace: As the argument.
    """

    def __init__(self, pace: Pace) -> None:
        self.pace = pace

    def events(
        self, ahead: FramesAhead[Event], mapper: Mapper, stop: Interruption, further: Callable[[], None]
    ) -> Iterator[Event]:
        """Yield the frames and corrections, and count the time that the mapper waits for them as `read`.

        Args:
            ahead: The frames and corrections.
            mapper: The mapper that they are for.
            stop: Ends the iteration after Ctrl-C.
            further: Called after each step that is made between two frames.
        """
        while True:
            with mapper.pipeline.stopwatch.measure("read"), stop.waiting():
                event = next(ahead, None)
            if event is None:
                return
            yield event

    def add(self, mapper: Mapper, frame: TrackedFrame) -> FrameReport | None:
        """Map a frame, as `Mapper.take` does."""
        return mapper.take(frame)

    def correct(self, mapper: Mapper, correction: PoseCorrection) -> None:
        """Apply a correction."""
        mapper.correct(correction)

    def schedule(self, settings: RefineSettings) -> Schedule | None:
        """Return the schedule of the refinement, None for `settings.steps`."""
        return None if settings.seconds is None else in_seconds(settings.seconds)

    def status(self) -> LiveStatus | None:
        """Return the recent figures of a realtime run, None for other runs."""
        return None

    def left(self) -> float | None:
        """Return the time until the map is to be in the output folder [s], None where there is no such time."""
        return None

    def note(self) -> dict[str, Any]:
        """Return what `RunRecord.frame` notes of the last frame in a realtime run."""
        return {}

    def write_session(self, folder: Path, config: SceneConfig) -> None:
        """Write what is needed to repeat a run that followed a clock.

        Args:
            folder: The output folder.
            config: The run's settings.
        """

    def saved(self) -> list[str]:
        """Called when the map has been written. Returns one-line remarks for the user about the run so far."""
        return []

    def metrics(self) -> dict[str, Any]:
        """Return the entries of `metrics.json` about a run that followed a clock."""
        return {}


class Observer:
    """Receives events of a run, such as finished frames and steps. This base class ignores them.

    The mapping thread makes the calls and waits for them to return. No other thread may access the map.

    Attributes:
        waited: Total time for which calls held the mapping at a person's request [s]. It does not count as mapping
            time.
    """

    waited = 0.0

    def begin(self, mapper: Mapper, frames: int | None) -> None:
        """Called before the first frame.

        Args:
            mapper: The mapper with its still empty map.
            frames: Number of frames that will come, None if unknown.
        """

    def on_frame(self, frame: TrackedFrame, report: FrameReport | None, live: LiveStatus | None = None) -> None:
        """Called after each frame.

        Args:
            frame: The frame.
            report: What the frame did to the map, None for a held-out frame.
            live: The figures of a realtime run, None for other runs.
        """

    def on_further_step(self) -> None:
        """Called after each step that a realtime run makes while no frame waits."""

    def on_step(self, stage: str, step: int, steps: int | None, psnr: float) -> None:
        """Called after each step of refinement, of offline optimisation or of the passes that finish an online map.

        Args:
            stage: "refining", "optimising" or "settling".
            step: Number of the step, from 1; when settling, of views.
            steps: Total number of them, None if it is not known.
            psnr: Mean PSNR of the step's views [dB].
        """

    def on_stage(self, stage: str) -> None:
        """Called when the map is finished and another stage begins. The map must not be accessed from here on."""


def open_observer(
    view: ViewSettings, say: Callable[..., None], insist: Callable[[str], None], held: ExitStack
) -> Observer:
    """Start the live viewer if the settings ask for it, and return what observes the run.

    Args:
        view: Settings of the viewer.
        say: Called with remarks for the user, which the report repeats.
        insist: Called with the address of the viewer, which nobody can guess.
        held: Closes the viewer when the run ends.
    """
    if not view.enabled:
        return Observer()
    from modp_ti.engine.live_viewer import LiveViewer  # here, because viser is an optional dependency

    viewer = LiveViewer(view, say)
    held.callback(viewer.close)
    insist(f"viewer: {viewer.page.address}")
    return viewer

"""`Conductor`: takes the tracker's frames and corrections to the mapper, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.interruption import Interruption
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.prefetch import FramesAhead
from modp_ti.files.errors import InputError
from modp_ti.inputs.protocol import Event
from modp_ti.outputs.progress import LiveStatus
from pipelines.companions.pace import Pace
from pipelines.pipeline import FrameReport
from pipelines.refinement import Schedule, in_seconds
from pipelines.settings import RefineSettings


def first_frame(arriving: FramesAhead[Event]) -> TrackedFrame:
    """Wait for the first frame and return it; it stays the next one of `arriving`.

    Raises:
        InputError: If there is none, or a correction comes before it.
    """
    first = next(arriving, None)
    if first is None:
        raise InputError("the tracker delivered no frame: nothing to map")
    if isinstance(first, PoseCorrection):
        raise InputError("the tracker corrects poses before its first frame")
    arriving.put_back(first)
    return first


def fitting(events: Iterator[Event], mapper: Mapper) -> Iterator[Event]:
    """Yield the frames and corrections. Raises InputError at the first frame that is too large for the mapper."""
    for event in events:
        if isinstance(event, TrackedFrame) and not mapper.takes(event.camera.width, event.camera.height):
            images = mapper.pipeline.renderer.images
            raise InputError(
                f"{event.name} is {event.camera.width}x{event.camera.height}, and frames of up to {images.max_width}x"
                f"{images.max_height} were expected from the first ones: send the largest images first, or one size"
            )
        yield event


class Conductor:
    """Takes frames and corrections to the mapper, each as soon as the mapper is done with the previous one.

    Args:
        pace: Pace of the mapper.
    """

    def __init__(self, pace: Pace) -> None:
        self._pace = pace

    @property
    def pace(self) -> Pace:
        """Pace of the mapper."""
        return self._pace

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

    def note(self) -> dict[str, Any]:
        """Return what `RunRecord.frame` notes of the last frame in a realtime run."""
        return {}

    @property
    def notes(self) -> list[str]:
        """One-line remarks for the user about the run so far."""
        return []

    def saved(self) -> None:
        """Called when the map has been written."""

    def write_session(self, folder: Path, config: SceneConfig) -> None:
        """Write what is needed to repeat a run that followed a clock.

        Args:
            folder: The output folder.
            config: The run's settings.
        """

    def metrics(self) -> dict[str, Any]:
        """Return the entries of `metrics.json` about a realtime run."""
        return {}

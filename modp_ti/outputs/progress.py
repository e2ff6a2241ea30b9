"""The progress line of a run, with the time left, and the figures of a realtime run."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.text import Text

from modp_ti.files.errors import without_secrets

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig
    from pipelines.pipeline import FrameReport, Pipeline

# Time that a stage must have run before an estimate is made [s].
EARLIEST = 10.0
# Share of the elapsed time whose items set the pace. Keyframes become slower as the map grows.
RECENT = 1 / 3
# An item that takes longer than this [s], and longer than all other recent ones together, is left out: it compiled
# kernels, or the run was paused meanwhile.
GAP = 5.0
# Optimisation time before the time of a view is known [s].
EARLIEST_VIEW = 1.0
# Time of a view at its full size over that at mapping's mean pyramid level: 20 and 14 ms on the demo.
FULL_SIZE = 1.4
# Times of other work, in views at their full size: reading and scoring a frame (80 and 86 ms on the demo at 480x360),
# and rendering a keyframe without a gradient.
SCORED, RENDERED = 1.0, 0.5
T = TypeVar("T")
# Time between two progress lines in a log [s].
LOG_EVERY = 30.0


class TimeLeft:
    """Estimates the remaining time of a stage whose items take different times.

    The pace is that of the items finished in the last third of the elapsed time, since a keyframe takes longer the
    larger the map is. No estimate is made in the first ten seconds, or if the number of items is unknown. An item that
    took longer than all others of them is left out, as the run was paused, or prepared itself.

    Args:
        total: Number of items; None if unknown.
        done: Number of items that are done already.
        clock: Returns the time [s].
        earliest: Time before the first estimate [s].

    Attributes:
        total: As the argument. It may be changed.
    """

    def __init__(
        self, total: int | None, done: int = 0, *, clock: Callable[[], float], earliest: float = EARLIEST
    ) -> None:
        self.total = total
        self._clock = clock
        self._earliest = earliest
        # Times and counts, oldest first. The first one is the latest that lies before the recent share.
        self._history: deque[tuple[float, int]] = deque([(clock(), done)])
        self._began = self._history[0][0]

    def update(self, done: int) -> None:
        """Set the number of items that are done."""
        if done <= self._history[-1][1]:
            return
        now = self._clock()
        self._history.append((now, done))
        since = now - RECENT * (now - self._began)
        while len(self._history) > 2 and self._history[1][0] <= since:
            self._history.popleft()

    def pace(self) -> float | None:
        """Return the recent time of an item [s], None if it is not known yet."""
        steps = [(now - then, done - before) for (then, before), (now, done) in pairwise(self._history)]
        if steps and (longest := max(steps))[0] > max(GAP, sum(seconds for seconds, _ in steps) - longest[0]):
            steps.remove(longest)
        if not steps or self._clock() - self._began < self._earliest:
            return None
        return sum(seconds for seconds, _ in steps) / sum(items for _, items in steps)

    def seconds(self) -> float | None:
        """Return the estimated time until the last item is done [s], None if it is not known yet."""
        pace = self.pace()
        return None if self.total is None or pace is None else (self.total - self._history[-1][1]) * pace


class TimeAfterMapping:
    """Estimates the time of what follows the last frame: the last passes, the refinement and the scores of the frames.

    All of it is counted in views. The time of a view is that of the recent ones, since it grows with the map.

    Args:
        config: The run's settings.
        pipeline: The run's map.
    """

    def __init__(self, config: SceneConfig, pipeline: Pipeline) -> None:
        self._config = config
        self._pipeline = pipeline
        self._views = TimeLeft(
            None,
            pipeline.renderer.view_renders,
            clock=lambda: pipeline.stopwatch.seconds.get("optimise", 0.0),
            earliest=EARLIEST_VIEW,
        )

    def seconds(self, done: int, frames: int | None) -> float | None:
        """Return the estimated time [s].

        Args:
            done: Number of frames that are mapped.
            frames: Number of frames that there will be, None if unknown.

        Returns:
            The time; None if it is not known yet, and for an offline map, whose optimisation comes only then.
        """
        self._views.update(self._pipeline.renderer.view_renders)
        pace = self._views.pace()
        if self._config.mode == "offline" or pace is None or not done or frames is None:
            return None
        keyframes = len(self._pipeline.keyframes) * frames / done
        views = self._config.mapping.optimise.last_views(round(keyframes))
        return views * pace * FULL_SIZE + self.after_passes(pace * FULL_SIZE, keyframes, frames)

    def after_passes(self, pace: float, keyframes: float, frames: int) -> float:
        """Return the estimated time of what follows the last passes: the refinement and the scores [s].

        Args:
            pace: Time of a view of full size [s].
            keyframes: Number of keyframes.
            frames: Number of frames.
        """
        refine = self._config.refine
        views = self.scores(frames) + (refine.steps * refine.views if refine.seconds is None else 0)
        if refine.wanted and refine.min_contribution:
            views += RENDERED * keyframes
        return pace * views + (refine.seconds or 0.0)

    def scores(self, frames: int) -> float:
        """Return the number of views that take as long as the scores of all frames in all versions of the map."""
        versions = 2 if self._config.refine.wanted and self._config.mode == "online" else 1
        return SCORED * versions * frames


def duration(seconds: float) -> str:
    """Return a duration as a person would say it: "40 s", "3 min" or "1 h 20 min"."""
    if seconds < 59.5:
        return f"{round(seconds)} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


@dataclass(frozen=True)
class LiveStatus:
    """The recent figures of a realtime run.

    Attributes:
        camera: Frames per second that arrive.
        tracked: Frames per second that get a pose.
        lag: Time from the last mapped frame's arrival to the map that holds it [s].
        waiting: Number of frames that wait for the mapper.
        steps: Mean number of optimisation steps of the last keyframes.
    """

    camera: float
    tracked: float
    lag: float
    waiting: int
    steps: float

    def text(self) -> str:
        """Return the figures in one line."""
        return (
            f"lag {self.lag:.1f} s, {self.waiting} waiting, camera {self.camera:.1f}/s, tracked {self.tracked:.1f}/s, "
            f"{self.steps:.1f} steps a keyframe"
        )


_shown: set[ProgressLine] = set()


@dataclass(frozen=True)
class StageProgress:
    """How far a stage of a run is.

    Attributes:
        what: Name of the stage.
        done: Number of items that are done.
        total: Number of its items, None if unknown.
        state: Figures of the map and the speed as text, "" if there are none.
        left: Time left as text, "" if it is not known.
    """

    what: str
    done: int = 0
    total: int | None = None
    state: str = ""
    left: str = ""

    def __str__(self) -> str:
        if self.total is None and not self.done:
            return self.what
        total = "" if self.total is None else f"/{self.total}"
        return f"{self.what} {self.done}{total}  {self.state}{self.left}".rstrip()


@contextmanager
def progress_ending() -> Iterator[None]:
    """End the lines that an exception inside this context has left on the terminal, and show its cursor again."""
    try:
        yield
    finally:
        for line in list(_shown):
            line.stop()
        Console(stderr=True).show_cursor(True)


class ProgressLine:
    """Shows the progress of a run in one line of a terminal, or in a line every 30 seconds otherwise.

    Args:
        console: Where it is shown.
        watch: Called with the progress whenever it changes.

    Attributes:
        until: Returns the time left of a run that ends at a given time [s], which is shown instead of an estimate; None
            where there is no such time.
    """

    def __init__(self, console: Console, watch: Callable[[StageProgress], None] | None = None) -> None:
        self.console = console
        self.until: Callable[[], float | None] = lambda: None
        self._watch = watch
        self._progress: Progress | None = None
        self._state = ""
        self._logged = 0.0
        self._left = TimeLeft(None, clock=time.monotonic)
        self._later: Callable[[float], float | None] = _nothing

    @contextmanager
    def working(self, what: str) -> Iterator[None]:
        """Show a status message while work of unknown length is in progress."""
        if self._watch is not None:
            self._watch(StageProgress(what))
        with self.console.status(Text(what)):
            yield

    def note(self, text: str) -> None:
        """Print a note for the user."""
        self.console.print(without_secrets(text), highlight=False, soft_wrap=True, markup=False)

    def insist(self, text: str) -> None:
        """Print what the user needs even if the console is quiet."""
        before, self.console.quiet = self.console.quiet, False
        self.note(text)
        self.console.quiet = before

    def prepare(self, what: str, done: int, total: int) -> None:
        """Show the progress of a tracker's preparation. Trackers take this method as their `Progress` callback."""
        if self._progress is None:
            self.start(what, total)
        self._update(description=what, completed=done, total=total)
        if done >= total:
            self.stop()

    def through(self, what: str, items: Iterable[T], total: int) -> Iterator[T]:
        """Yield the items, showing how many are done."""
        self.start(what, total)
        try:
            for item in items:
                if self._progress is None:  # a tracker has shown how it prepares in its place
                    self.start(what, total)
                yield item
                self.advance()
        finally:
            self.stop()

    def start(
        self,
        what: str,
        total: int | None,
        done: int = 0,
        later: Callable[[float], float | None] | None = None,
    ) -> None:
        """Begin the line of a stage.

        Args:
            what: Name of the stage.
            total: Number of its items, None if unknown.
            done: Number of items that are done already.
            later: Returns the time that the following stages will take [s], given the recent time of an item [s].
                While it returns None, no time is shown. None if nothing follows.
        """
        self.stop()
        self._left = TimeLeft(total, done, clock=time.monotonic)
        self._later = later or _nothing
        self._state = ""
        self._logged = time.monotonic()
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=8),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[state]}{task.fields[left]}", markup=False),
            console=self.console,
        )
        self._progress.add_task(what, total=total, completed=done, state="", left="")
        _shown.add(self)
        self._progress.start()
        if self._watch is not None:
            self._watch(StageProgress(what, done, total))

    def frame(self, report: FrameReport | None, total: int | None = None, live: LiveStatus | None = None) -> None:
        """Count a finished frame.

        Args:
            report: What the frame did to the map, None if it is held out.
            total: Number of frames as it is known now, None if it has not changed.
            live: The figures of a realtime run, None for other runs.
        """
        if report is not None:
            psnr = "" if report.psnr is None else f"  {report.psnr:.2f} dB"
            gaussians = f"  {report.gaussians:,} Gaussians" if report.gaussians else ""
            self._state = f"{report.keyframes} keyframes{gaussians}{psnr}"
        frame_rate = self._progress.tasks[0].speed if self._progress is not None else None
        speed = f"  {frame_rate:.2f} frames/s" if frame_rate else ""
        state = self._state + speed if live is None else f"{live.text()}, {self._state}"
        changed = {} if total is None else {"total": total}
        self._update(advance=1, state=state, **changed)

    def step(self, step: int, psnr: float, gaussians: int | None = None) -> None:
        """Show a finished step of refinement or, with the number of Gaussians, of offline optimisation."""
        size = "" if gaussians is None else f"{gaussians:,} Gaussians  "
        self._update(completed=step, state=f"{size}{psnr:.2f} dB")

    def advance(self) -> None:
        """Count a finished item of the current stage."""
        self._update(advance=1)

    def stop(self) -> None:
        """End the line and leave its last state on the screen."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None
            _shown.discard(self)

    def summary(self, metrics: dict) -> None:
        """Print the run's result in one line. A run without scores has none there."""
        scores = metrics["refined"] or metrics["online"] or metrics["offline"]
        which = "held_out" if scores["held_out"]["count"] else "all"
        psnr, ssim, lpips = (scores[which][name] for name in ("psnr", "ssim", "lpips"))
        fitted = scores["fitted"]["psnr"]
        self.note(
            f"{metrics['frames']} frames, {metrics['keyframes']} keyframes, {metrics['gaussians']:,} Gaussians, "
            f"{metrics['frames_per_second']:.2f} frames/s"
            + ("" if psnr is None else f"; {which.replace('_', '-')} PSNR {psnr:.2f} dB, SSIM {ssim:.3f}")
            + ("" if lpips is None else f", LPIPS {lpips:.3f}")
            + ("" if fitted is None else f"; fitted PSNR {fitted:.2f} dB")
        )

    def _update(self, **changes: Any) -> None:
        """Change the line, with the time left, tell the watcher, and log now and then."""
        if self._progress is None:
            raise RuntimeError("no progress is shown: call `start` first")
        task = self._progress.tasks[0]
        self._progress.update(task.id, **changes)
        done, total = int(task.completed), None if task.total is None else int(task.total)
        self._left.total = total
        self._left.update(done)
        left, pace = self._left.seconds(), self._left.pace()
        later = None if left is None or pace is None or task.finished else self._later(pace)
        whole = None if left is None or later is None else left + later
        if (until := self.until()) is not None:
            whole = max(until, 0.0)
        text = "" if whole is None else f"  {duration(whole)} left"
        self._progress.update(task.id, left=text)
        progress = StageProgress(task.description, done, total, task.fields["state"], text)
        if self._watch is not None:
            self._watch(progress)
        if not self.console.is_terminal and time.monotonic() - self._logged >= LOG_EVERY:
            self._logged = time.monotonic()
            self.note(str(progress))


def _nothing(_: float) -> float:
    return 0.0

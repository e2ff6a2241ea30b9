"""Estimates of the time that a run still takes, from the recent pace of its stages."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig
    from pipelines.pipeline import Pipeline

__all__ = ["RECENT", "TimeAfterMapping", "TimeLeft", "duration"]

# Time that a stage must have run before an estimate is made [s].
EARLIEST = 10.0
# Share of the elapsed time whose items set the pace. Keyframes become slower as the map grows.
RECENT = 1 / 3
# An item that takes longer than this [s], and longer than all other recent ones together, is a gap: the run was paused,
# or its process stopped. A second one within so many items is none.
GAP, GAP_APART = 5.0, 100

# Optimisation time before the time of a view is known [s].
EARLIEST_VIEW = 1.0
# Time of a view at its full size over that at mapping's mean pyramid level: 20 and 14 ms on the demo.
FULL_SIZE = 1.4
# Times of other work, in views at their full size: reading and scoring a frame (80 and 86 ms on the demo at 480x360),
# and rendering a keyframe without a gradient.
SCORED, RENDERED = 1.0, 0.5


class TimeLeft:
    """Estimates the remaining time of a stage whose items take different times.

    The pace is by default that of the items finished in the last third of the elapsed time, since a keyframe takes
    longer the larger the map is. No estimate is made in the first ten seconds, or if the number of items is unknown.
    Gaps are left out.

    Args:
        total: Number of items; None if unknown.
        done: Number of items that are done already.
        clock: Returns the time [s].
        earliest: Time before the first estimate [s].
        prepares: Whether the time of the first item includes preparations; it is then left out.

    Attributes:
        total: As the argument. It may be changed.
    """

    def __init__(
        self,
        total: int | None,
        done: int = 0,
        *,
        clock: Callable[[], float],
        earliest: float = EARLIEST,
        prepares: bool = False,
    ) -> None:
        self.total = total
        self._clock = clock
        self._earliest = earliest
        self._prepares = prepares
        self._began = clock()
        self._done = done
        # Times and counts, oldest first. The first one is the latest that lies before the recent share.
        self._history: deque[tuple[float, int]] = deque([(self._began, done)])
        self._gaps = 0.0  # [s]
        self._gap_at = -GAP_APART  # number of items that were done at the last gap

    def update(self, done: int) -> None:
        """Set the number of items that are done."""
        now = self._clock() - self._gaps
        first, last = self._history[0][0], self._history[-1][0]
        items = done > self._done and not self._prepares
        if items and now - last > max(GAP, last - first):
            if self._done - self._gap_at >= GAP_APART:
                self._gaps += now - last
                now = last
            self._gap_at = self._done
        if self._prepares and done > self._done:
            self._prepares, self._began = False, now
            self._history = deque([(now, done)])
        self._done = done
        self._history.append((now, done))
        since = now - RECENT * (now - self._began)
        while len(self._history) > 2 and self._history[1][0] <= since:
            self._history.popleft()

    def pace(self) -> float | None:
        """Return the recent time of an item [s], None if it is not known yet."""
        now = self._clock() - self._gaps
        then, before = self._history[0]
        if now - self._began < self._earliest or self._done <= before:
            return None
        return (now - then) / (self._done - before)

    def seconds(self) -> float | None:
        """Return the estimated time until the last item is done [s], None if it is not known yet."""
        pace = self.pace()
        return None if self.total is None or pace is None else (self.total - self._done) * pace


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

"""`Pace`: how much work a frame gets; all of the settings, what a clock allows, or recorded decisions."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from pipelines.settings import MappingSettings, OptimiseSettings

# Number of keyframes that are assumed before the first one, in the estimate of how many there will be.
BEFORE = 4
# Number of keyframes from which on Gaussians that hardly show are removed.
FIRST_SWEEP = 64
# Steps that every keyframe gets, however long the recording is.
LEAST_STEPS = 2


@dataclass(frozen=True, slots=True)
class Plan:
    """The work that a keyframe gets. Its tracked points are added in any case.

    Attributes:
        pixels: Share of `densify.pixels` whose depth is estimated, from 0 to 1.
        steps: Number of optimisation steps.
        swept: Number of keyframes in which it is then measured how much of each Gaussian shows, for the removal of
            those that hardly show in any (`HiddenGaussians`). None for all that are near, each time that half as many
            have come again.
    """

    pixels: float
    steps: int
    swept: int | None = 0


class Pace(Protocol):
    """Protocol of a policy that decides how much work a frame gets."""

    def takes_keyframe(self) -> bool:
        """Return whether a frame that should become a keyframe does. Otherwise it only adds its tracked points."""
        ...

    def plan(self, level: int, keyframes: int, frames: int) -> Plan:
        """Return the work of a new keyframe, optimised on a pyramid level, the last of so many keyframes and frames."""
        ...

    def steps_after_correction(self, keyframes: int, frames: int) -> int:
        """Return the number of optimisation steps after a correction that moved Gaussians."""
        ...

    def last_views(self, keyframes: int) -> int:
        """Return the number of views of the last passes over a finished map of so many views."""
        ...


class CompletePace:
    """Gives every keyframe the work of the settings, however long it takes.

    Gaussians that hardly show are removed each time that the number of keyframes has grown by a half, so that rendering
    all keyframes for it takes a few views per keyframe, however many there are (`HiddenGaussians.sweep_when_due`).

    The keyframes of a long recording share the steps of `optimise.budget` keyframes evenly. Their number is expected
    from those so far: with k keyframes in the first f of n frames, n k / f. Nothing else is remembered, so that a
    resumed run decides the same.

    Args:
        settings: Settings of the mapping.
        frames: Number of frames of the whole recording, without the held-out ones; None if unknown, for no budget.
    """

    def __init__(self, settings: MappingSettings, frames: int | None = None) -> None:
        self._settings = settings
        self._frames = frames

    def takes_keyframe(self) -> bool:
        return True

    def plan(self, level: int, keyframes: int, frames: int) -> Plan:
        steps = round(self.share(keyframes, frames) * self._settings.optimise.steps)
        return Plan(1.0, steps, swept=None)

    def steps_after_correction(self, keyframes: int, frames: int) -> int:
        return round(self.share(keyframes, frames) * self._settings.corrections.steps)

    def last_views(self, keyframes: int) -> int:
        return self._settings.optimise.last_views(keyframes)

    def share(self, keyframes: int, frames: int) -> float:
        """Return the share of the settings' steps for which the budget suffices, as far as the frames so far tell."""
        budget, steps = self._settings.optimise.budget, self._settings.optimise.steps
        if budget is None or self._frames is None or steps == 0:
            return 1.0
        # As if a few keyframes at the largest distance came first: the first frames tell little.
        rate = (keyframes + BEFORE) / (frames + BEFORE * self._settings.keyframes.max_gap)
        return min(1.0, max(budget / (rate * self._frames), LEAST_STEPS / steps))


# Weight of a new measurement. The mean follows a growing map within some ten keyframes, and one hiccup moves it little.
COST_WEIGHT = 0.15


class Costs:
    """Running means of measured times by kind of work.

    The first measurements are averaged, later ones have the weight `COST_WEIGHT`.
    """

    def __init__(self) -> None:
        self._mean: dict[str, float] = {}
        self._count: dict[str, int] = {}

    def learn(self, kind: str, seconds: float) -> None:
        """Add a measurement of one unit of this kind [s]."""
        count = self._count[kind] = self._count.get(kind, 0) + 1
        before = self._mean.get(kind, seconds)
        self._mean[kind] = before + max(COST_WEIGHT, 1.0 / count) * (seconds - before)

    def of(self, kind: str, unknown: float) -> float:
        """Return the mean of a kind [s], or `unknown` before its first measurement."""
        return self._mean.get(kind, unknown)

    def known(self) -> dict[str, float]:
        """Return all means [s] by kind."""
        return dict(self._mean)


class LearningPace(Pace):
    """Base of the paces that follow a clock: is told what the work has cost, and keeps the decisions.

    Args:
        settings: Settings of the mapping.

    Attributes:
        costs: The measured costs.
        decisions: The decisions so far, for `RecordedPace`.
    """

    def __init__(self, settings: MappingSettings) -> None:
        self._settings = settings
        self.costs = Costs()
        self.decisions: list[Plan | None] = []
        self._planned: tuple[Plan, int] | None = None  # plan and level of the current frame's keyframe
        self._aside = 0.0  # time of other work since the last keyframe

    def end_frame(self, seconds: float, depth: float = 0.0, optimise: float = 0.0, steps: int = 0) -> None:
        """Called after each frame with the times that it took.

        Args:
            seconds: Time of the whole frame [s].
            depth: Time of the depth at high-error pixels [s].
            optimise: Time of the optimisation steps [s].
            steps: Their number.
        """
        planned, self._planned = self._planned, None
        if planned is None:
            self._aside += seconds
            return
        plan, level = planned
        if plan.pixels > 0 and depth > 0:
            self.costs.learn(f"depth {level}", depth / _share_of_depth(plan.pixels))
        if steps:
            self.costs.learn(f"step {level}", optimise / steps)
        self.costs.learn("keyframe", seconds - depth - (optimise if steps else 0.0))

    def steps_after_correction(self, keyframes: int, frames: int) -> int:
        """Return 0: the ordinary steps mend the seams, by the same clock as everything else."""
        return 0

    def last_views(self, keyframes: int) -> int:
        return bounded_last_views(self._settings.optimise, keyframes)


# Lag at the start of a keyframe that the pace holds, as a share of `max_lag`, and share of a deviation from it that is
# made up for within one keyframe. A share between 0 and 1 lets the lag approach the goal without oscillating.
GOAL = 0.25
GAIN = 0.5
# Steps of a keyframe below which depth gives way first. redkitchen's first 600 frames at 20 a second, with the costs of
# one core at 320x240: held-out 26.8 dB with one, 27.5 with two, 27.6 with four, whose lag is longer.
LEAST_WORK = 3
# Smallest share of the pixels that is worth the fixed costs of their depth.
LEAST_PIXELS = 0.2
# Share of the cost of depth that does not depend on the number of pixels: 0.39 at 320x240, more on coarser levels.
FIXED_DEPTH = 0.4
# Assumed costs before the first measurement [s].
KEYFRAME, DEPTH, STEP = 0.03, 0.2, 0.1
# Share of the time that keyframes without work may take beyond `max_lag`; the rest reduces the lag. Some are kept,
# so that no part of the recording remains without views.
KEEPING = 0.5
# Keyframes that are swept with each kept keyframe, for the removal of Gaussians that hardly show. With three, a
# sweep ends when the keyframes are half as many again as when it began. Skipped keyframes sweep too: where a large map
# leaves no time for steps, removal is what makes it smaller.
SWEPT = 3
# Weight of a new interval between keyframes in their mean.
WEIGHT = 0.2


class RealtimePace(LearningPace):
    """Gives every keyframe the work that fits into the time until the next one.

    The pace never reads a clock. It is told when each frame arrived, when the mapper began with it, and what the work
    cost. The time of a keyframe is

        interval + GAIN (goal - lag) - aside,

    with the mean interval between keyframes, the lag at its start, and the time that other frames and corrections take
    between two keyframes. If the costs are as expected, each keyframe brings the lag closer to the goal by the factor
    1 - GAIN. The time is limited to `max_lag - lag`, so that the keyframe itself is in the map in time.

    If there is too little time, this gives way in turn:

    1. optimisation steps, down to `LEAST_WORK`,
    2. the depth of high-error pixels, by fewer pixels and then entirely,
    3. work on whole keyframes, evenly: the keyframe is kept as a view, with its tracked points alone (skipped), and its
       time is saved up for the next one,
    4. beyond `max_lag`, keyframes themselves, evenly, so that keeping the others takes no more than the share
       `KEEPING` of the time: the frame only adds its tracked points (merged).

    Args:
        settings: Settings of the mapping.

    Attributes:
        lag: Time from the arrival of the current frame to the start of its work [s].
        merged: Number of merged keyframes.
        skipped: Number of skipped keyframes.
    """

    def __init__(self, settings: MappingSettings) -> None:
        super().__init__(settings)
        self.max_lag = settings.max_lag
        self.most_steps = settings.optimise.steps
        self.lag = 0.0
        self.merged = self.skipped = 0
        self._arrived = 0.0
        self._interval = 0.5 * settings.max_lag
        self._last_keyframe: float | None = None  # arrival of the last frame that should have become a keyframe
        self._saved = 0.0  # time of skipped and merged keyframes that nothing else has used [s]
        self._late = 0.0  # time since the last kept keyframe, while the lag is beyond `max_lag` [s]

    # ---- what the pace is told -------------------------------------------------------------------------------

    def begin_frame(self, arrived: float, now: float) -> None:
        """Called before each frame with the time at which it arrived, and the present time on the same clock [s]."""
        self._arrived = arrived
        self.lag = max(0.0, now - arrived)

    def spend_aside(self, seconds: float) -> None:
        """Count time that something other than frames took, such as a correction [s]."""
        self._aside += seconds

    def spend_idle(self, seconds: float) -> None:
        """Count time for which the mapper made further steps while no frame was waiting [s]."""
        self._saved = max(0.0, self._saved - seconds)

    # ---- decisions -------------------------------------------------------------------------------------------

    def takes_keyframe(self) -> bool:
        self._note_interval()
        taken = True
        if self.lag > self.max_lag and self.decisions:
            self._late += self._each()
            taken = KEEPING * self._late >= self.costs.of("keyframe", KEYFRAME)
        self._late = 0.0 if taken else self._late
        if not taken:
            self.merged += 1
            self._saved += self._each()
            self.decisions.append(None)
        return taken

    def plan(self, level: int, keyframes: int, frames: int) -> Plan:
        plan = self._plan(keyframes, self._time(), self._cost("depth", level, DEPTH), self._cost("step", level, STEP))
        self._planned = plan, level
        if plan.steps == 0 and self.most_steps > 0:
            self.skipped += 1
            self._saved += self._each()
        else:
            self._saved = 0.0
        self.decisions.append(plan)
        return plan

    def _note_interval(self) -> None:
        if self._last_keyframe is not None:
            # Longer pauses do not foretell the next interval, and no keyframe may take longer anyway.
            interval = min(self._arrived - self._last_keyframe, self.max_lag)
            self._interval += WEIGHT * (interval - self._interval)
            self.costs.learn("aside", self._aside)
        self._last_keyframe, self._aside = self._arrived, 0.0

    def _each(self) -> float:
        """Return the mean time between keyframes that other frames and corrections leave [s]."""
        return max(0.0, self._interval - self.costs.of("aside", 0.0))

    def _time(self) -> float:
        """Return the time for the keyframe that begins now [s]."""
        time = self._each() + self._saved + GAIN * (GOAL * self.max_lag - self.lag)
        return min(time, self.max_lag - self.lag) - self.costs.of("keyframe", KEYFRAME)

    def _cost(self, kind: str, level: int, unknown: float) -> float:
        """Return the expected cost of work on this level [s]. Coarser levels cost no more than finer ones."""
        known = [self.costs.of(f"{kind} {finer}", float("inf")) for finer in range(level + 1)]
        return min(known) if min(known) < float("inf") else unknown

    def _plan(self, keyframes: int, time: float, depth: float, step: float) -> Plan:
        least = min(LEAST_WORK, self.most_steps)
        swept = SWEPT if keyframes >= FIRST_SWEEP and time > 0.0 else 0
        if time < least * step or time <= 0.0:
            return Plan(0.0, 0, swept)
        pixels = _pixels_for((time - least * step) / depth)
        time -= depth * _share_of_depth(pixels) if pixels else 0.0
        return Plan(pixels, int(min(max(time / step, least), self.most_steps)), swept)


def bounded_last_views(settings: OptimiseSettings, keyframes: int) -> int:
    """Return the views of the last passes: after a live session of many keyframes, those of `budget` keyframes."""
    return settings.last_views(keyframes if settings.budget is None else min(keyframes, settings.budget))


def _share_of_depth(pixels: float) -> float:
    """Return the cost of the depth of a share of the pixels, relative to that of all of them."""
    return FIXED_DEPTH + (1.0 - FIXED_DEPTH) * pixels


def _pixels_for(cost: float) -> float:
    """Return the share of the pixels whose depth has this relative cost, 0 if that is too few."""
    pixels = min(1.0, (cost - FIXED_DEPTH) / (1.0 - FIXED_DEPTH))
    return round(pixels, 3) if pixels >= LEAST_PIXELS else 0.0


class RecordedPace:
    """Repeats recorded decisions in their order, so that the same frames give the same map.

    Args:
        settings: Settings of the mapping.
        decisions: For every frame that should have become a keyframe, its plan, or None if it was merged.
    """

    def __init__(self, settings: MappingSettings, decisions: Iterable[Plan | None]) -> None:
        self._settings = settings
        self._decisions = iter(decisions)
        self._next: Plan | None = None

    def takes_keyframe(self) -> bool:
        """Return the next decision.

        Raises:
            ValueError: If the recording has no further decision, so that its frames were other ones.
        """
        try:
            self._next = next(self._decisions)
        except StopIteration:
            raise ValueError("the recorded decisions end before the frames: these are other frames") from None
        return self._next is not None

    def plan(self, level: int, keyframes: int, frames: int) -> Plan:
        assert self._next is not None, "takes_keyframe comes first, and was True"
        return self._next

    def steps_after_correction(self, keyframes: int, frames: int) -> int:
        return 0

    def last_views(self, keyframes: int) -> int:
        return bounded_last_views(self._settings.optimise, keyframes)

"""`TimedPace`: the steps of each keyframe for the best map that can be made in a given time."""

from __future__ import annotations

from collections.abc import Callable

from pipelines.companions.pace import BEFORE, LEAST_STEPS, LearningPace, Plan
from pipelines.settings import MappingSettings

# Share of the time of optimisation that is spent while mapping. The rest is that of the refinement. Of 20, 40 and 63 %
# in the same time, the last is best on desk and courthouse, and redkitchen is indifferent (docs/method.md).
MAPPING = 0.7
# Steps of a keyframe beyond which the time goes to the refinement.
MOST_STEPS = 30
# Assumed costs before the first measurement [s], and number of frames of a keyframe.
FRAME, STEP, GAP = 0.1, 0.1, 2
# Keyframes by which the mean cost of a step lags, and number of measurements that the assumed growth of it counts as.
LAG, ASSUMED = 6, 16
# Largest expected growth of that cost: what a view shows does not grow with a long recording.
MOST_GROWTH = 6.0


class TimedPace(LearningPace):
    """Shares the time that is left among the keyframes to come, the last passes and the refinement.

    At each keyframe, the time left for optimisation is

        left - frame x (frames to come) - view x (views of the last passes),

    with the mean time `frame` that a frame takes besides the steps: reading, tracking, depth. Of all time of
    optimisation, spent and left, the keyframes get the share `MAPPING`, and each one to come the same number of steps
    in what remains of it: at least `LEAST_STEPS`, and at most `MOST_STEPS`. Each gets the depth of all its pixels. The
    refinement gets what is left.

    Args:
        settings: Settings of the mapping. `optimise.steps` and `corrections.steps` have no effect.
        frames: Number of frames of the recording, without the held-out ones; None if unknown.
        left: Returns the time until the map must be finished [s].
        refines: Whether a refinement follows. Without one, the keyframes get all of the time.
    """

    def __init__(
        self, settings: MappingSettings, frames: int | None, left: Callable[[], float], refines: bool = True
    ) -> None:
        super().__init__(settings)
        self._frames = frames
        self._left = left
        self._share = MAPPING if refines else 1.0
        self._spent = 0.0  # time of the steps so far [s]
        self._measured: list[float] = []  # cost of a step of each keyframe [s]
        self._before: tuple[float, int] | None = None  # time left without the steps so far, and frames, when last asked

    def takes_keyframe(self) -> bool:
        return True

    def plan(self, level: int, keyframes: int, frames: int) -> Plan:
        total = 2 * frames if self._frames is None else max(self._frames, frames)
        coming = (total - frames) * (keyframes + BEFORE) / (frames + GAP * BEFORE)
        step, growth = self.costs.of("step", STEP), self._growth(keyframes, coming)
        passes = growth * self.costs.of("step 0", step) * self.last_views(round(keyframes + coming))
        optimisation = self._optimisation(total - frames, frames) - passes / self._settings.views.per_step
        each = (self._share * optimisation - self._spent) / (1.0 + coming)
        plan = Plan(1.0, int(min(max(each / (growth * step), LEAST_STEPS), MOST_STEPS)), swept=None)
        self._planned = plan, level
        self.decisions.append(plan)
        return plan

    def end_frame(self, seconds: float, depth: float = 0.0, optimise: float = 0.0, steps: int = 0) -> None:
        if self._planned is not None and steps:
            self.costs.learn("step", optimise / steps)
            self._measured.append(optimise / steps)
            self._spent += optimise
        super().end_frame(seconds, depth, optimise, steps)

    def _growth(self, keyframes: int, coming: float) -> float:
        """Return the mean cost of the steps to come, relative to the present one.

        Steps become slower as the map grows: first as if in proportion to the keyframes, later by the trend so far.
        """
        growth = 0.5 * coming / (max(0.5 * keyframes, keyframes - LAG) + BEFORE)
        if count := len(self._measured):
            trend = 1.0 - sum(self._measured) / count / self.costs.of("step", STEP)
            growth += count / (count + ASSUMED) * (max(trend, 0.0) * coming / keyframes - growth)
        return min(1.0 + growth, MOST_GROWTH)

    def _optimisation(self, coming: int, frames: int) -> float:
        """Return the time of all optimisation [s], spent and left, and learn what frames take besides."""
        whole = self._left() + self._spent
        if self._before is not None and frames > self._before[1]:
            self.costs.learn("frame", (self._before[0] - whole) / (frames - self._before[1]))
        self._before = whole, frames
        return whole - coming * self.costs.of("frame", FRAME)

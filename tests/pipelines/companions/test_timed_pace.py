"""The pace of a given time, with a clock that moves by what the simulated work costs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from pipelines.companions.pace import LEAST_STEPS, Plan
from pipelines.companions.timed_pace import MAPPING, MOST_STEPS, TimedPace
from pipelines.settings import MappingSettings

SETTINGS = MappingSettings()
LEVELS = SETTINGS.levels.probabilities


@dataclass
class SimulatedRun:
    """Spends made-up times on the frames, the last passes and the refinement of a recording.

    Attributes:
        frames: Number of frames.
        every: Number of frames from one keyframe to the next.
        frame: Cost of a frame besides the steps of keyframes [s].
        step: Cost of a step at the full size, by the share of the recording that is mapped [s].
        plans: Plans of the keyframes.
        now: The time [s].
        keyframes, refinement: Time of the keyframes' steps and of the refinement [s].
    """

    frames: int = 120
    every: int = 3
    frame: float = 0.05
    step: Callable[[float], float] = lambda _: 0.1
    plans: list[Plan] = field(default_factory=list)
    now: float = 0.0
    keyframes: float = 0.0
    refinement: float = 0.0

    def run(self, seconds: float, known: bool = True) -> SimulatedRun:
        pace = TimedPace(SETTINGS, self.frames if known else None, lambda: seconds - self.now)
        rng = np.random.default_rng(3)
        for n in range(self.frames):
            self.now += self.frame * rng.uniform(0.7, 1.3)
            optimise, steps = 0.0, 0
            if n % self.every == 0:
                assert pace.takes_keyframe()
                level = int(rng.choice(len(LEVELS), p=LEVELS))
                plan = pace.plan(level, len(self.plans) + 1, n + 1)
                self.plans.append(plan)
                steps = plan.steps
                optimise = steps * self.step(n / self.frames) * 0.5**level * rng.uniform(0.8, 1.2)
            self.now += optimise
            self.keyframes += optimise
            pace.end_frame(optimise + 0.01, 0.0, optimise, steps)
        view = self.step(1.0) / SETTINGS.views.per_step
        self.now += pace.last_views(len(self.plans)) * view
        while self.now < seconds:
            self.now += 4 * view
            self.refinement += 4 * view
        return self

    @property
    def steps(self) -> np.ndarray:
        return np.array([plan.steps for plan in self.plans])


def steady(_: float) -> float:
    return 0.1


def growing(mapped: float) -> float:
    """Four times as much in the end as in the beginning."""
    return 0.04 + 0.12 * mapped


@pytest.mark.parametrize("step", [steady, growing])
@pytest.mark.parametrize("frame", [0.005, 0.05, 0.5])
@pytest.mark.parametrize("seconds", [0.0, 10.0, 30.0, 60.0, 120.0, 240.0, 1000.0])
@pytest.mark.parametrize("known", [True, False])
def test_a_run_ends_later_than_its_deadline_only_if_its_least_work_does(
    step: Callable[[float], float], frame: float, seconds: float, known: bool
) -> None:
    least, run = SimulatedRun(frame=frame, step=step).run(0.0), SimulatedRun(frame=frame, step=step)
    assert set(least.steps.tolist()) == {LEAST_STEPS}
    run.run(seconds, known)
    one_step = 4 * step(1.0) / SETTINGS.views.per_step
    assert run.now <= (max(seconds, 1.05 * least.now) if known else seconds + least.now) + one_step
    assert run.now >= seconds, "and all of the time is used"
    assert all(plan.pixels == 1.0 for plan in run.plans) and len(run.plans) == 40


@pytest.mark.parametrize("step", [steady, growing])
@pytest.mark.parametrize("seconds", [8.0, 30.0, 60.0, 150.0])
def test_twice_the_time_gives_every_keyframe_and_the_refinement_at_least_as_much(
    step: Callable[[float], float], seconds: float
) -> None:
    once, twice = SimulatedRun(step=step).run(seconds), SimulatedRun(step=step).run(2 * seconds)
    assert (twice.steps[3:] >= once.steps[3:]).all() and twice.steps.sum() >= once.steps.sum()
    assert twice.refinement >= once.refinement


@pytest.mark.parametrize("step", [steady, growing])
@pytest.mark.parametrize(("frames", "every", "seconds"), [(120, 3, 60.0), (500, 5, 120.0), (60, 1, 60.0)])
def test_keyframes_and_refinement_share_the_time_however_costs_change(
    step: Callable[[float], float], frames: int, every: int, seconds: float
) -> None:
    run = SimulatedRun(frames, every, step=step).run(seconds)
    assert run.keyframes / (run.keyframes + run.refinement) == pytest.approx(MAPPING, abs=0.06)
    thirds = [third.mean() for third in np.array_split(run.steps, 3)]
    assert min(thirds) > 0.125 * max(thirds) and min(thirds) > LEAST_STEPS, "no part has all or nothing"


def test_what_keyframes_cannot_use_goes_to_the_refinement() -> None:
    run = SimulatedRun().run(5000.0)
    assert set(run.steps[1:].tolist()) == {MOST_STEPS} and run.refinement > 0.9 * run.now

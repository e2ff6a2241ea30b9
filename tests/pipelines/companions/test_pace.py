"""The pace: complete, realtime, recorded, and of a given time, with clocks that move by what simulated work costs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from pipelines.companions.pace import LEAST_STEPS, CompletePace, Plan, RealtimePace, RecordedPace
from pipelines.companions.timed_pace import MAPPING, MOST_STEPS, TimedPace
from pipelines.settings import CorrectionSettings, MappingSettings, OptimiseSettings


@pytest.mark.parametrize(("every", "steps"), [(1, 4), (3, 12), (5, 20)])
def test_the_keyframes_of_a_long_recording_share_its_budget_evenly(every: int, steps: int) -> None:
    """133 keyframes' 30 steps are 4,000 steps, for 1,000 frames and a keyframe every first, third or fifth."""
    settings = MappingSettings(
        optimise=OptimiseSettings(steps=30, budget=133), corrections=CorrectionSettings(steps=60)
    )
    pace = CompletePace(settings, frames=1000)
    given = [pace.plan(0, 1 + frame // every, 1 + frame).steps for frame in range(0, 1000, every)]
    assert sum(given) == pytest.approx(4000, rel=0.1)
    assert set(given[len(given) // 4 :]) <= {steps - 1, steps, steps + 1}
    assert pace.steps_after_correction(1000 // every, 1000) == pytest.approx(2 * given[-1], abs=1)


def test_a_short_recording_and_one_of_unknown_length_get_all_steps() -> None:
    settings = MappingSettings(optimise=OptimiseSettings(steps=7, budget=20))
    short, unknown = CompletePace(settings, frames=20), CompletePace(settings)
    assert [short.plan(0, 1 + i, 1 + i).steps for i in range(20)] == [7] * 20
    assert [unknown.plan(0, 1 + i, 1 + i).steps for i in range(1000)] == [7] * 1000


def test_every_keyframe_gets_two_steps_at_least() -> None:
    for asked, given in ((7, 2), (2, 2), (1, 1), (0, 0)):
        settings = MappingSettings(optimise=OptimiseSettings(steps=asked, budget=1))
        assert CompletePace(settings, frames=10_000).plan(0, 100, 100).steps == given


def test_recorded_decisions_are_repeated_in_their_order() -> None:
    plans = [Plan(1.0, 3, 2), None, Plan(0.5, 0)]
    pace = RecordedPace(MappingSettings(), plans)
    repeated = [pace.plan(0, 1, 1) if pace.takes_keyframe() else None for _ in plans]
    assert repeated == plans


def test_other_frames_than_the_recorded_ones_are_an_error() -> None:
    pace = RecordedPace(MappingSettings(), [None])
    assert not pace.takes_keyframe()
    with pytest.raises(ValueError):
        pace.takes_keyframe()


SETTINGS = MappingSettings()

LEVELS = SETTINGS.levels.probabilities


@dataclass
class SimulatedMapper:
    """Spends made-up times on frames, in order, and tells the pace what they cost.

    Attributes:
        step: Cost of a step at the full size [s].
        depth: Cost of the depth of all high-error pixels [s].
        keyframe: Other costs of a keyframe [s].
        points: Cost of a frame that only adds its tracked points [s].
        every: Number of frames from one wanted keyframe to the next.
        hiccups: Extra time at a frame, by its number [s].
    """

    step: float = 0.08
    depth: float = 0.2
    keyframe: float = 0.03
    points: float = 0.006
    every: int = 4
    hiccups: dict[int, float] = field(default_factory=dict)

    def run(self, arrivals: np.ndarray, pace: RealtimePace) -> Session:
        """Map frames that arrive at these times (N,) [s]."""
        rng = np.random.default_rng(5)
        session = Session()
        now = float(arrivals[0])
        for n, arrived in enumerate(arrivals.tolist()):
            while now < arrived:  # nothing waits
                cost = self.step * 4 / 6
                session.idle += cost
                pace.spend_idle(cost)
                now += cost
            pace.begin_frame(arrived, now)
            session.waiting.append(int(np.searchsorted(arrivals, now, side="right")) - n)
            plan = None
            depth = optimise = 0.0
            seconds = self.points * rng.uniform(0.7, 1.3)
            if n % self.every == 0:
                if pace.takes_keyframe():
                    level = int(rng.choice(len(LEVELS), p=LEVELS))
                    plan = pace.plan(level, 1, 1)
                    seconds, depth, optimise = self.costs_of(plan, level, rng)
                session.plans.append(plan)
            seconds += depth + optimise
            pace.end_frame(seconds, depth, optimise, plan.steps if plan else 0)
            now += seconds + self.hiccups.get(n, 0.0)
            session.lag.append(now - arrived)
        session.end = now
        return session

    def costs_of(self, plan: Plan, level: int, rng: np.random.Generator) -> tuple[float, float, float]:
        """Times of the keyframe itself, of its depth and of its steps [s]."""
        keyframe, depth, step = (mean * rng.uniform(0.7, 1.3) for mean in (self.keyframe, self.depth, self.step))
        # Half of the cost of depth is fixed, which is not the pace's own model of it.
        depth *= 0.5 + 0.5 * plan.pixels if plan.pixels else 0.0
        return keyframe, depth, plan.steps * step * 0.5**level


@dataclass
class Session:
    """What a simulated session did: lag [s] of every frame and frames waiting at it, plans of the wanted keyframes,
    time left over [s], and the time of the end [s]."""

    lag: list[float] = field(default_factory=list)
    waiting: list[int] = field(default_factory=list)
    plans: list[Plan | None] = field(default_factory=list)
    idle: float = 0.0
    end: float = 0.0

    def worked(self) -> np.ndarray:
        """Places of the keyframes that got steps."""
        return np.flatnonzero([plan is not None and plan.steps > 0 for plan in self.plans])


def camera(rate: float, seconds: float) -> np.ndarray:
    """Times at which the frames of a camera arrive that is a little irregular."""
    jitter = np.random.default_rng(1).uniform(0.0, 0.3 / rate, round(rate * seconds))
    return np.arange(round(rate * seconds)) / rate + jitter


@pytest.mark.parametrize("rate", [10, 30])
@pytest.mark.parametrize("every", [1, 3, 5])
@pytest.mark.parametrize("slow", [0.5, 1.0, 3.0])
def test_the_lag_stays_below_its_limit_at_every_rate(rate: float, every: int, slow: float) -> None:
    pace = RealtimePace(SETTINGS)
    mapper = SimulatedMapper(0.08 * slow, 0.2 * slow, 0.03 * slow, 0.006 * slow, every)
    session = mapper.run(camera(rate, 60.0), pace)
    # Over forty draws of the costs and the camera, the worst of all cases is 1.5 to 2.4, and 1.10 to 1.32.
    assert max(session.lag) < 3.5 * SETTINGS.max_lag
    assert np.quantile(session.lag, 0.95) < 1.6 * SETTINGS.max_lag
    # The mapper is never idle for want of a plan, nor does its queue grow.
    assert np.mean(session.waiting[-100:]) < rate * SETTINGS.max_lag + 1


@pytest.mark.parametrize("rate", [10, 30])
def test_a_hiccup_is_caught_up_with(rate: float) -> None:
    pace = RealtimePace(SETTINGS)
    hiccup = round(20 * rate)
    session = SimulatedMapper(hiccups={hiccup: 3.0}).run(camera(rate, 40.0), pace)
    assert max(session.lag[:hiccup]) < 2 * SETTINGS.max_lag
    assert session.lag[hiccup] > 3.0
    assert max(session.lag[hiccup + round(5 * rate) :]) < 2 * SETTINGS.max_lag


def test_a_camera_that_wants_too_many_keyframes_still_leaves_views_everywhere() -> None:
    pace = RealtimePace(SETTINGS)
    session = SimulatedMapper(keyframe=0.09, every=1).run(camera(30, 60.0), pace)
    kept = np.flatnonzero([plan is not None for plan in session.plans])
    assert pace.merged > 100 and max(session.lag) < 2 * SETTINGS.max_lag
    gaps = np.diff(kept[5:])
    assert gaps.max() <= 2 * np.median(gaps) + 2


def test_steps_give_way_before_depth_and_depth_before_whole_keyframes() -> None:
    """The slower the machine, the less of each; nothing gives way before what comes first has."""
    shares = []
    for slow in (0.3, 0.7, 1.0, 2.0, 4.0):
        pace = RealtimePace(SETTINGS)
        session = SimulatedMapper(0.08 * slow, 0.2 * slow, 0.03 * slow, 0.006, every=4).run(camera(10, 60.0), pace)
        plans = [plan for plan in session.plans[20:] if plan is not None]
        worked = [plan for plan in plans if plan.steps]
        shares.append(
            (
                np.mean([plan.steps for plan in plans]) / SETTINGS.optimise.steps,
                np.mean([plan.pixels for plan in worked]),
                len(worked) / len(session.plans[20:]),
            )
        )
    steps, pixels, keyframes = np.array(shares).T
    assert (np.diff(steps) < 0.02).all() and (np.diff(keyframes) < 0.02).all()
    assert steps[1] < 0.8 and pixels[1] > 0.95 and keyframes[1] > 0.95, "only steps give way at first"
    assert pixels[2] < pixels[1] and keyframes[2] > 0.9, "then depth"
    assert keyframes[-1] < 0.8, "then whole keyframes"


def test_the_decisions_are_those_that_the_mapper_was_given() -> None:
    pace = RealtimePace(SETTINGS)
    session = SimulatedMapper(hiccups={50: 3.0}).run(camera(10, 30.0), pace)
    assert pace.decisions == session.plans
    assert pace.merged == sum(plan is None for plan in session.plans)


@pytest.mark.parametrize(("step", "steps"), [(0.02, True), (1.0, False)])
def test_each_kept_keyframe_sweeps_over_three_once_there_are_many(step: float, steps: bool) -> None:
    """Also those for which there is no time for steps, as long as the lag is below the limit."""
    pace = RealtimePace(SETTINGS)
    pace.costs.learn("step 0", step)
    plans = []
    for n in range(1, 100):
        late = SETTINGS.max_lag if n == 90 else 0.0
        pace.begin_frame(arrived=float(n), now=float(n) + late)
        assert pace.takes_keyframe()
        plans.append(pace.plan(0, n, n))
        pace.end_frame(0.1)
    assert all((plan.steps > 0) == (steps and n != 89) for n, plan in enumerate(plans))
    assert [plan.swept for plan in plans] == [0] * 63 + [3] * 26 + [0] + [3] * 9


def test_the_last_passes_of_a_long_session_take_no_longer_than_those_of_the_budget() -> None:
    passes, budget = SETTINGS.optimise.last_passes, SETTINGS.optimise.budget
    of_session, of_replay = RealtimePace(SETTINGS), RecordedPace(SETTINGS, [])
    for keyframes in (1, 20, 139, 140, 141, 1000):
        views = of_session.last_views(keyframes)
        assert views == of_replay.last_views(keyframes) == SETTINGS.optimise.last_views(min(keyframes, budget))
    assert of_session.last_views(1000) == passes * budget
    unlimited = SETTINGS.model_copy(update={"optimise": SETTINGS.optimise.model_copy(update={"budget": None})})
    assert RealtimePace(unlimited).last_views(1000) == passes * 1000


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

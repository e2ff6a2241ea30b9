"""The pace that knows no clock, and the one that repeats decisions."""

from __future__ import annotations

import pytest

from pipelines.companions.pace import CompletePace, Plan
from pipelines.companions.realtime_pace import RecordedPace
from pipelines.settings import CorrectionSettings, MappingSettings, OptimiseSettings


def test_the_complete_pace_gives_what_the_settings_say() -> None:
    pace = CompletePace(MappingSettings(optimise=OptimiseSettings(steps=7), corrections=CorrectionSettings(steps=3)))
    assert pace.takes_keyframe()
    assert pace.plan(level=2, keyframes=1, frames=1) == Plan(1.0, 7, swept=None)
    assert pace.steps_after_correction(keyframes=1, frames=1) == 3


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
    with pytest.raises(ValueError, match="these are other frames"):
        pace.takes_keyframe()

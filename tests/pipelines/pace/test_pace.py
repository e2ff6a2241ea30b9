"""The pace that knows no clock, and the one that repeats decisions."""

from __future__ import annotations

import pytest

from pipelines.pace import CompletePace, Plan, RecordedPace
from pipelines.settings import CorrectionSettings, MappingSettings, OptimiseSettings


def test_the_complete_pace_gives_what_the_settings_say() -> None:
    pace = CompletePace(MappingSettings(optimise=OptimiseSettings(steps=7), corrections=CorrectionSettings(steps=3)))
    assert pace.takes_keyframe()
    assert pace.plan(level=2) == Plan(1.0, 7)
    assert pace.steps_after_correction() == 3


def test_recorded_decisions_are_repeated_in_their_order() -> None:
    plans = [Plan(1.0, 3), None, Plan(0.5, 0)]
    pace = RecordedPace(plans)
    repeated = [pace.plan(level=0) if pace.takes_keyframe() else None for _ in plans]
    assert repeated == plans


def test_other_frames_than_the_recorded_ones_are_an_error() -> None:
    pace = RecordedPace([None])
    assert not pace.takes_keyframe()
    with pytest.raises(ValueError, match="these are other frames"):
        pace.takes_keyframe()

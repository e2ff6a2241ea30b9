"""The pace of the online mapper: how much work each frame gets."""

from __future__ import annotations

from pipelines.pace.pace import CompletePace, Pace, Plan
from pipelines.pace.realtime import RealtimePace, RecordedPace

__all__ = ["CompletePace", "Pace", "Plan", "RealtimePace", "RecordedPace"]

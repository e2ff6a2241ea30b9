"""`RecordedPace`: repeats the decisions of an earlier run."""

from __future__ import annotations

from collections.abc import Iterable

from pipelines.pace.pace import Plan
from pipelines.pace.realtime import bounded_last_views
from pipelines.settings import MappingSettings

__all__ = ["RecordedPace"]


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

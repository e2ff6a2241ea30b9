"""`RunClock`: how long a run has taken, over all the processes that it took."""

from __future__ import annotations

import time

__all__ = ["RunClock"]


class RunClock:
    """Seconds of the whole run and of its mapping, with those that came before this process (`total`, `mapping`)."""

    def __init__(self, clock=time.perf_counter) -> None:
        self._clock = clock
        self._began = clock()
        self._mapping_since: float | None = None
        self._before = self._mapped = 0.0

    @property
    def total(self) -> float:
        return self._before + self._clock() - self._began

    @property
    def mapping(self) -> float:
        now = self._clock()
        return self._mapped + (0.0 if self._mapping_since is None else now - self._mapping_since)

    def resume(self, total: float, mapping: float) -> None:
        """Count what a run took until its snapshot; what came after it was lost."""
        self._before, self._mapped = total, mapping

    def begin_mapping(self) -> None:
        self._mapping_since = self._clock()

    def end_mapping(self, waited: float = 0.0) -> None:
        """The last frame is mapped. waited: seconds in which a person had it wait."""
        self._mapped, self._mapping_since = self.mapping - waited, None

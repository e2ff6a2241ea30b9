"""`RunClock`: the time that a run has taken, summed over all processes of a resumed run; and its peak memory."""

from __future__ import annotations

import sys
import time


class RunClock:
    """Measures the time of the whole run (`total`) and of its mapping (`mapping`) [s], including earlier processes."""

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
        """Set the time that the run took until its snapshot. Later time is not counted, as its work was lost."""
        self._before, self._mapped = total, mapping

    def begin_mapping(self) -> None:
        self._mapping_since = self._clock()

    def end_mapping(self, waited: float = 0.0) -> None:
        """Stop the mapping clock after the last frame.

        Args:
            waited: Time for which a person paused the mapping [s]. It is subtracted.
        """
        self._mapped, self._mapping_since = self.mapping - waited, None


def peak_memory_mb() -> float | None:
    """Return the peak memory of this process so far [10^6 bytes]; None on Windows."""
    try:
        import resource
    except ImportError:
        return None
    unit = 1 if sys.platform == "darwin" else 1024  # macOS counts bytes, Linux kibibytes
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6, 1)

"""The median of values that arrive one after the other."""

from __future__ import annotations

from bisect import insort

__all__ = ["RunningMedian"]


class RunningMedian:
    """Keeps its values sorted: one more costs the search for its place, not another look at all of them."""

    def __init__(self) -> None:
        self._sorted: list[float] = []

    def __len__(self) -> int:
        return len(self._sorted)

    def add(self, value: float) -> None:
        insort(self._sorted, value)

    @property
    def value(self) -> float:
        """The median so far, the mean of the middle two of an even number. Raises IndexError where there is none."""
        middle = len(self._sorted) // 2
        if len(self._sorted) % 2:
            return self._sorted[middle]
        return 0.5 * (self._sorted[middle - 1] + self._sorted[middle])

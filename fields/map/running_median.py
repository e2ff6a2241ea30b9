"""The median of a stream of values."""

from __future__ import annotations

from bisect import insort

__all__ = ["RunningMedian"]


class RunningMedian:
    """Median of the values added so far, kept in a sorted list."""

    def __init__(self) -> None:
        self._sorted: list[float] = []

    def __len__(self) -> int:
        return len(self._sorted)

    def add(self, value: float) -> None:
        """Add a value."""
        insort(self._sorted, value)

    @property
    def value(self) -> float:
        """Median of the values; the mean of the middle two if their number is even.

        Raises:
            IndexError: If no value has been added.
        """
        middle = len(self._sorted) // 2
        if len(self._sorted) % 2:
            return self._sorted[middle]
        return 0.5 * (self._sorted[middle - 1] + self._sorted[middle])

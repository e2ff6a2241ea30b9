"""`Costs`: running means of what the parts of a frame's work cost."""

from __future__ import annotations

__all__ = ["Costs"]

# Weight of a new measurement. The mean follows a growing map within some ten keyframes, and one hiccup moves it little.
WEIGHT = 0.15


class Costs:
    """Running means of measured times by kind of work.

    The first measurements are averaged, later ones have the weight `WEIGHT`.
    """

    def __init__(self) -> None:
        self._mean: dict[str, float] = {}
        self._count: dict[str, int] = {}

    def learn(self, kind: str, seconds: float) -> None:
        """Add a measurement of one unit of this kind [s]."""
        count = self._count[kind] = self._count.get(kind, 0) + 1
        before = self._mean.get(kind, seconds)
        self._mean[kind] = before + max(WEIGHT, 1.0 / count) * (seconds - before)

    def of(self, kind: str, unknown: float) -> float:
        """Return the mean of a kind [s], or `unknown` before its first measurement."""
        return self._mean.get(kind, unknown)

    def known(self) -> dict[str, float]:
        """Return all means [s] by kind."""
        return dict(self._mean)

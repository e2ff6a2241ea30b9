"""Time per stage, as in the paper's breakdown of time."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

# The stages of the paper's breakdown: Optim, Cam Select, Depth Est., MOHV.
BREAKDOWN = ("optimise", "select", "depth", "occupancy")


class Stopwatch:
    """Accumulates wall-clock time by stage.

    Attributes:
        seconds: Time of each stage [s].
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Context manager that adds the time of its block to `stage`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


def breakdown_percent(seconds: Mapping[str, float], total: float) -> dict[str, float]:
    """Compute the percentage of each stage, as in the paper's breakdown of time.

    Args:
        seconds: Time of each stage [s].
        total: Total time of the mapping [s].

    Returns:
        Percentages of the paper's stages, and of the rest as `others`.
    """
    percent = {stage: 100.0 * seconds.get(stage, 0.0) / total for stage in BREAKDOWN}
    percent["others"] = 100.0 - sum(percent.values())
    return {stage: round(value, 2) for stage, value in percent.items()}

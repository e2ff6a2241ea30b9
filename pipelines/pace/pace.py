"""`Pace`: the protocol of a policy that decides how much work a frame gets, and the pace that knows no clock."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from pipelines.settings import MappingSettings

__all__ = ["CompletePace", "Pace", "Plan"]


@dataclass(frozen=True, slots=True)
class Plan:
    """The work that a keyframe gets. Its tracked points are added in any case.

    Attributes:
        pixels: Share of `densify.pixels` whose depth is estimated, from 0 to 1.
        steps: Number of optimisation steps.
    """

    pixels: float
    steps: int


class Pace(Protocol):
    """Protocol of a policy that decides how much work a frame gets."""

    def takes_keyframe(self) -> bool:
        """Return whether a frame that should become a keyframe does. Otherwise it only adds its tracked points."""
        ...

    def plan(self, level: int) -> Plan:
        """Return the work of a new keyframe.

        Args:
            level: Pyramid level on which it is optimised.
        """
        ...

    def steps_after_correction(self) -> int:
        """Return the number of optimisation steps after a correction that moved Gaussians."""
        ...


class CompletePace:
    """Gives every keyframe all the work of the settings, however long it takes.

    Args:
        settings: Settings of the mapping.
    """

    def __init__(self, settings: MappingSettings) -> None:
        self._plan = Plan(1.0, settings.optimise.steps)
        self._after_correction = settings.corrections.steps

    def takes_keyframe(self) -> bool:
        return True

    def plan(self, level: int) -> Plan:
        return self._plan

    def steps_after_correction(self) -> int:
        return self._after_correction

"""`Pace`: the protocol of a policy that decides how much work a frame gets, and the pace that knows no clock."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from pipelines.settings import MappingSettings

# Number of keyframes that are assumed before the first one, in the estimate of how many there will be.
BEFORE = 4
# Number of keyframes from which on Gaussians that hardly show are removed.
FIRST_SWEEP = 64
# Steps that every keyframe gets, however long the recording is.
LEAST_STEPS = 2


@dataclass(frozen=True, slots=True)
class Plan:
    """The work that a keyframe gets. Its tracked points are added in any case.

    Attributes:
        pixels: Share of `densify.pixels` whose depth is estimated, from 0 to 1.
        steps: Number of optimisation steps.
        swept: Number of keyframes in which it is then measured how much of each Gaussian shows, for the removal of
            those that hardly show in any (`HiddenGaussians`). None for all that are near, each time that half as many
            have come again.
    """

    pixels: float
    steps: int
    swept: int | None = 0


class Pace(Protocol):
    """Protocol of a policy that decides how much work a frame gets."""

    def takes_keyframe(self) -> bool:
        """Return whether a frame that should become a keyframe does. Otherwise it only adds its tracked points."""
        ...

    def plan(self, level: int, keyframes: int, frames: int) -> Plan:
        """Return the work of a new keyframe.

        Args:
            level: Pyramid level on which it is optimised.
            keyframes: Number of keyframes so far, with this one.
            frames: Number of frames so far, with this one.
        """
        ...

    def steps_after_correction(self, keyframes: int, frames: int) -> int:
        """Return the number of optimisation steps after a correction that moved Gaussians.

        Args:
            keyframes: Number of keyframes so far.
            frames: Number of frames so far.
        """
        ...

    def last_views(self, keyframes: int) -> int:
        """Return the number of views of the last passes over the finished map.

        Args:
            keyframes: Number of keyframes, with the frames between them that are views.
        """
        ...


class CompletePace:
    """Gives every keyframe the work of the settings, however long it takes.

    Gaussians that hardly show are removed each time that the number of keyframes has grown by a half, so that rendering
    all keyframes for it takes a few views per keyframe, however many there are (`HiddenGaussians.sweep_when_due`).

    The keyframes of a long recording share the steps of `optimise.budget` keyframes evenly. Their number is expected
    from those so far: with k keyframes in the first f of n frames, n k / f. Nothing else is remembered, so that a
    resumed run decides the same.

    Args:
        settings: Settings of the mapping.
        frames: Number of frames of the whole recording, without the held-out ones; None if unknown, for no budget.
    """

    def __init__(self, settings: MappingSettings, frames: int | None = None) -> None:
        self._settings = settings
        self._frames = frames

    def takes_keyframe(self) -> bool:
        return True

    def plan(self, level: int, keyframes: int, frames: int) -> Plan:
        steps = round(self.share(keyframes, frames) * self._settings.optimise.steps)
        return Plan(1.0, steps, swept=None)

    def steps_after_correction(self, keyframes: int, frames: int) -> int:
        return round(self.share(keyframes, frames) * self._settings.corrections.steps)

    def last_views(self, keyframes: int) -> int:
        return self._settings.optimise.last_views(keyframes)

    def share(self, keyframes: int, frames: int) -> float:
        """Return the share of the settings' steps for which the budget suffices, as far as the frames so far tell."""
        budget, steps = self._settings.optimise.budget, self._settings.optimise.steps
        if budget is None or self._frames is None or steps == 0:
            return 1.0
        # As if a few keyframes at the largest distance came first: the first frames tell little.
        rate = (keyframes + BEFORE) / (frames + BEFORE * self._settings.keyframes.max_gap)
        return min(1.0, max(budget / (rate * self._frames), LEAST_STEPS / steps))

"""Safeguards: what went wrong in a step and was undone, counted, so that a run can say so."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

__all__ = ["EXPLODED", "Safeguards"]

# Standard deviation [scene depths] beyond which a Gaussian shows nothing of the scene any more.
EXPLODED = 100.0


@dataclass
class Safeguards:
    """How often each guard has caught something.

    gaussian_steps: steps of a Gaussian whose gradient was no number or beyond all bounds; it kept value and moments.
    exploded_gaussians: those that had grown beyond `EXPLODED`, made transparent, so that the next pruning takes them.
    camera_steps: steps of a keyframe's pose, or its alignment, that were no number or would have carried it away.
    exposure_steps: steps of an exposure that were no number. views: views of a step whose loss was no number.
    gaussians_without_room, keyframes_without_room, observations_without_room: those that were left out for want of
    memory (`MemoryBudget`).
    """

    gaussian_steps: int = 0
    exploded_gaussians: int = 0
    camera_steps: int = 0
    exposure_steps: int = 0
    views: int = 0
    gaussians_without_room: int = 0
    keyframes_without_room: int = 0
    observations_without_room: int = 0

    def counts(self) -> dict[str, int]:
        """The counts by their names."""
        return asdict(self)

    def restore(self, counts: dict[str, int]) -> None:
        """Go on from former counts."""
        for field in fields(self):
            setattr(self, field.name, int(counts[field.name]))

    def warning(self) -> str | None:
        """One line about what was caught; None where nothing was."""
        meanings = {
            "gaussian_steps": "steps of Gaussians with gradients that are no numbers were left out",
            "exploded_gaussians": "Gaussians that had grown beyond all bounds were removed",
            "camera_steps": "steps that would have carried a camera away were undone",
            "exposure_steps": "steps of exposures that are no numbers were left out",
            "views": "views had a loss that is no number",
            "gaussians_without_room": "Gaussians found no room (mapping.max_gaussians, mapping.memory)",
            "keyframes_without_room": "keyframes found no room (mapping.memory)",
            "observations_without_room": "observations of tracked points found no room (mapping.memory)",
        }
        caught = [f"{count:,} {meanings[name]}" for name, count in self.counts().items() if count]
        return f"guards: {'; '.join(caught)}" if caught else None

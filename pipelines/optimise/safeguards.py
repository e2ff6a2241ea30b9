"""Safeguards: counts of failures that were caught, so that a run can report them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

# Standard deviation [scene depths] beyond which a Gaussian no longer represents any part of the scene.
EXPLODED = 100.0


@dataclass
class Safeguards:
    """Counts of what each safeguard has caught.

    Attributes:
        gaussian_steps: Skipped steps of Gaussians whose gradient was not finite or too large.
        exploded_gaussians: Gaussians that grew beyond `EXPLODED`. They are made transparent, so that the next pruning
            removes them.
        camera_steps: Steps and alignments of a pose that were not finite or diverged.
        exposure_steps: Steps of an exposure whose gradient was not finite.
        views: Views of a step whose loss was not finite.
        gaussians_without_room: Gaussians that were not added for lack of memory (`MemoryBudget`).
        keyframes_without_room: Keyframes that were not added for lack of memory.
        observations_without_room: Observations of tracked points that were not kept for lack of memory.
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
        """Return the counts by name."""
        return asdict(self)

    def restore(self, counts: dict[str, int]) -> None:
        """Restore the result of `counts`."""
        for field in fields(self):
            setattr(self, field.name, int(counts[field.name]))

    def warning(self) -> str | None:
        """Return one line about what was caught; None if nothing was."""
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

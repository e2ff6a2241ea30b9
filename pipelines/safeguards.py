"""What keeps a map sound: counts of failures that were caught, and `MemoryBudget`, the limit on its memory."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.map.gaussians import GaussianField
from fields.map.keyframes import KeyframeStore
from fields.voxels.occupancy import OccupancyVoxels

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


# Bytes of an observation: the id of the point and its pixel.
OBSERVATION = 12


class MemoryBudget:
    """Limits the memory of Gaussians, of the keyframes' images and points, of voxels, and of data kept outside the map.

    The usage is computed from the map's contents rather than queried from the OS, so that runs are reproducible.
    Anything that does not fit is left out and counted in `safeguards`: Gaussians are not added, and a frame that would
    have become a keyframe is treated as one between keyframes. The optimisation of the existing map continues. A
    Gaussian is only added if the voxels that it may mark fit as well, so that the limit is never exceeded.

    Args:
        limit: Limit [bytes]; None for no limit. The pool of `gaussians` is a limit in any case.
        gaussians: The Gaussians of the map.
        keyframes: The keyframes of the map.
        voxels: The voxels of the map, if it has any.
        safeguards: Counter of what was left out.

    Attributes:
        beside: Bytes of data about the frames that are kept outside the map.
    """

    def __init__(
        self,
        limit: float | None,
        gaussians: GaussianField,
        keyframes: KeyframeStore,
        voxels: OccupancyVoxels | None,
        safeguards: Safeguards,
    ) -> None:
        self.limit = limit
        self.gaussians = gaussians
        self.keyframes = keyframes
        self.voxels = voxels
        self.safeguards = safeguards
        self.beside = 0

    def held(self) -> int:
        """Return the bytes currently in use."""
        voxels = 0 if self.voxels is None else self.voxels.nbytes
        return len(self.gaussians) * self.gaussians.bytes_each + self.keyframes.nbytes + voxels + self.beside

    def may_cut(self, count: int) -> bool:
        """Whether `take_gaussians` may reject some of `count` new Gaussians."""
        return self.limit is not None or count > self.gaussians.capacity - len(self.gaussians)

    def take_gaussians(self, position: NDArray[np.float64], size: float) -> int:
        """Return how many of the first positions (N, 3) fit as Gaussians, with the voxels of a size that they may mark.

        The others are counted as rejected.
        """
        taken = min(len(position), self.gaussians.capacity - len(self.gaussians))
        if self.limit is not None:
            cost = np.full(taken, self.gaussians.bytes_each)
            if self.voxels is not None:
                cost += self.voxels.bytes_to_mark(position[:taken], size)
            taken = int(np.searchsorted(np.cumsum(cost), self.limit - self.held(), side="right"))
        self.safeguards.gaussians_without_room += len(position) - taken
        return taken

    def takes_keyframe(self, frame: TrackedFrame) -> bool:
        """Whether a frame's images and points fit. Rejections are counted."""
        fits = self.limit is None or self.held() + self.keyframes.bytes_of(frame) <= self.limit
        self.safeguards.keyframes_without_room += not fits
        return fits

    def takes_between(self, frame: TrackedFrame) -> bool:
        """Whether a frame between keyframes fits into half of the limit; the other half is for what the map needs."""
        return self.limit is None or self.held() + self.keyframes.bytes_of(frame) <= 0.5 * self.limit

    def takes_observations(self, count: int) -> bool:
        """Whether `count` more observations of tracked points fit. Rejections are counted."""
        fits = self.limit is None or self.held() + count * OBSERVATION <= self.limit
        self.safeguards.observations_without_room += 0 if fits else count
        return fits

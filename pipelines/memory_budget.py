"""`MemoryBudget`: a limit on the memory of a map, so that long recordings do not run out of memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.map.gaussians import GaussianField
from fields.map.keyframes import KeyframeStore
from fields.voxels.occupancy import OccupancyVoxels
from pipelines.optimise.safeguards import Safeguards

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
        """Determine how many new Gaussians fit, together with the voxels that they may mark.

        Args:
            position: Positions (N, 3) in order of preference.
            size: Target voxel size [scene units].

        Returns:
            Number of leading positions that fit. The others are counted as rejected.
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

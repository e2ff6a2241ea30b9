"""`MemoryBudget`: what a map may take of the memory, so that a long recording ends with a map, not out of memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.map.gaussians import GaussianField
from fields.map.keyframes import KeyframeStore
from fields.map.occupancy import OccupancyVoxels
from pipelines.optimise.safeguards import Safeguards

__all__ = ["OBSERVATION", "MemoryBudget"]

# Bytes of a point that a frame saw: which, and its pixel.
OBSERVATION = 12


class MemoryBudget:
    """Keeps Gaussians, keyframes' images and points, voxels, and what is kept beside them within a number of bytes.

    It is reckoned from what the map holds, and not asked of the system: two runs refuse the same. What has no room is
    left out and counted in `safeguards`: Gaussians are not added, and a frame that would have been a keyframe is one
    like those between keyframes. The map goes on being optimised with what it has. A Gaussian is taken only if there is
    room for the voxels that it may mark too, so the limit is never exceeded.

    limit: in bytes, None for none; the pool of `gaussians` is a limit in any case. beside: bytes that others than the
    map keep of the frames.
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
        """Bytes that are held now."""
        voxels = 0 if self.voxels is None else self.voxels.nbytes
        return len(self.gaussians) * self.gaussians.bytes_each + self.keyframes.nbytes + voxels + self.beside

    def take_gaussians(self, position: NDArray[np.float64], size: float) -> int:
        """Reserve room for Gaussians at positions (N, 3) with voxel target size `size`, in their order.

        Returns:
            How many of the leading positions have room, with the voxels that they may mark; the others are counted.
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
        """Whether there is room for a frame's images and points; counted where not."""
        fits = self.limit is None or self.held() + self.keyframes.bytes_of(frame) <= self.limit
        self.safeguards.keyframes_without_room += not fits
        return fits

    def takes_observations(self, count: int) -> bool:
        """Whether there is room for so many more of what frames saw of the tracker's points; counted where not."""
        fits = self.limit is None or self.held() + count * OBSERVATION <= self.limit
        self.safeguards.observations_without_room += 0 if fits else count
        return fits

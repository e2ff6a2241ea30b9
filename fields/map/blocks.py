"""`Blocks`: a division of space into cubes, and which views see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera

# Coordinates of cubes are clipped to this, so that they fit into 32 bits.
FARTHEST = float(2**31 - 1)
# Size of a sphere over the smallest side beyond which cubes do not grow further.
LARGEST = 2.0**100


@dataclass(frozen=True, slots=True)
class Boxes:
    """The smallest boxes, with sides along the axes, around each block's Gaussians.

    Attributes:
        low: Lowest coordinates (B, 3) in the world frame.
        high: Highest coordinates (B, 3).
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.low)

    def __getitem__(self, which: NDArray | slice) -> Boxes:
        return Boxes(self.low[which], self.high[which])

    @staticmethod
    def joined(parts: Sequence[Boxes]) -> Boxes:
        """Return the boxes of all parts, in order."""
        none = np.zeros((0, 3))
        return Boxes(np.concatenate([none, *(p.low for p in parts)]), np.concatenate([none, *(p.high for p in parts)]))

    def distance(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance (B,) of a point (3,) from each box, 0 inside."""
        return np.linalg.norm(np.maximum(np.maximum(self.low - point, point - self.high), 0.0), axis=1)


@dataclass(frozen=True)
class Blocks:
    """Cubes of space that hold the means of at least one Gaussian.

    Attributes:
        boxes: Boxes around each block.
        members: Places of the Gaussians, in the order of the blocks.
        first: Place (B + 1,) of each block's first member in `members`.
    """

    boxes: Boxes
    members: NDArray[np.int64]
    first: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.boxes)

    def of(self, block: int) -> NDArray[np.int64]:
        """Return the places of a block's Gaussians, in increasing order."""
        return self.members[self.first[block] : self.first[block + 1]]

    @property
    def counts(self) -> NDArray[np.int64]:
        """Number (B,) of Gaussians in each block."""
        return np.diff(self.first)


def planes_of(camera: PinholeCamera, T_camera_world: NDArray[np.float64], far: float) -> NDArray[np.float64]:
    """Return the planes (6, 4) that bound what a view sees: the points x with n . x + d > 0 for all planes (n, d).

    Args:
        camera: Its camera.
        T_camera_world: Its pose (4, 4).
        far: Depth beyond which it counts as seeing nothing [scene units], possibly infinite.
    """
    inwards = np.array(
        [
            [camera.fx, 0.0, camera.cx],
            [-camera.fx, 0.0, camera.width - camera.cx],
            [0.0, camera.fy, camera.cy],
            [0.0, -camera.fy, camera.height - camera.cy],
            [0.0, 0.0, 1.0],
            [0.0, 0.0, -1.0],
        ]
    )
    planes = inwards @ T_camera_world[:3]
    planes[5, 3] += far
    return planes


def divide(position: NDArray[np.floating], extent: NDArray[np.floating], side: float) -> Blocks:
    """Divide spheres into blocks by their centres, in lexicographic order of the blocks' cells.

    Large spheres go to cubes of twice the side, or four times, and so on, so that none reaches farther than a quarter
    of a side beyond its cube. In one cube, a few large spheres would have every view see all of the small ones.

    Args:
        position: Centres (N, 3) in the world frame.
        extent: Radii (N,) [scene units].
        side: Side of the smallest blocks [scene units]. The origin of the world is a corner of one.
    """
    level = np.ceil(np.log2(np.clip(4.0 * extent.astype(np.float64) / side, 1.0, LARGEST))).astype(np.int32)
    members, first = _groups([level, *_cubes(position, np.ldexp(side, level))])
    return Blocks(_around(position, extent, members, first), members, np.append(first, len(members)))


def _cubes(position: NDArray[np.floating], sides: NDArray[np.float64]) -> list[NDArray[np.int32]]:
    """Return the coordinates (N,) along each axis of the cubes of these sides (N,) that positions (N, 3) lie in."""
    cubes = []
    for axis in range(3):  # one at a time, in place and in 32 bits, because a map may have millions of Gaussians
        cube = position[:, axis].astype(np.float64)
        cube /= sides
        np.clip(np.floor(cube, out=cube), -FARTHEST, FARTHEST, out=cube)
        cubes.append(cube.astype(np.int32))
    return cubes


def _groups(numbers: Sequence[NDArray[np.int32]]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return places (N,) in lexicographic order of their numbers, and where places (G,) with other numbers begin."""
    members = np.lexsort(numbers[::-1])  # stable: equal places keep their order
    if len(members) == 0:
        return members, np.zeros(0, dtype=np.int64)
    begins = np.ones(len(members), dtype=bool)
    begins[1:] = False
    for number in numbers:
        begins[1:] |= np.diff(number[members]) != 0
    return members, np.flatnonzero(begins)


def extent_of(log_scale: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return radii (N,) of spheres that hold three standard deviations of Gaussians, given log_scale (N, 3)."""
    return 3.0 * np.exp(log_scale.max(axis=1))


def box_of(position: NDArray[np.floating], extent: NDArray[np.floating]) -> Boxes:
    """Return the box around all spheres, given their centres (N, 3) and radii (N,), N >= 1."""
    return _around(position, extent, np.arange(len(position)), np.zeros(1, dtype=np.int64))


def _around(
    position: NDArray[np.floating], extent: NDArray[np.floating], members: NDArray[np.int64], first: NDArray[np.int64]
) -> Boxes:
    """Boxes around consecutive groups of `members`, places of spheres; the groups begin at `first` (B,)."""
    low, high = np.zeros((len(first), 3)), np.zeros((len(first), 3))
    if len(first):
        radius = extent[members].astype(np.float64)
        for axis in range(3):
            centre = position[members, axis].astype(np.float64)
            low[:, axis] = np.minimum.reduceat(centre - radius, first)
            high[:, axis] = np.maximum.reduceat(centre + radius, first)
    return Boxes(low, high)


def seen(planes: NDArray[np.float64], boxes: Boxes) -> NDArray[np.bool_]:
    """Return which views, given by their planes (V, 6, 4), see which of B boxes (V, B), at least in part.

    Occlusion does not count. A box beside the image that two planes cut may count as seen without being so.
    """
    visible = np.ones((len(planes), len(boxes)), dtype=bool)
    centre, half = 0.5 * (boxes.low + boxes.high), 0.5 * (boxes.high - boxes.low)
    for plane in range(6):
        n, d = planes[:, plane, :3], planes[:, plane, 3:]
        visible &= n @ centre.T + np.abs(n) @ half.T + d > 0  # the corner that lies farthest along the normal
    return visible

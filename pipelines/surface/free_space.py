"""Which space of a finished map is free, solid or unknown, carved with the depth of its views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.surface.fusion import Placed, supporting_views

UNKNOWN, FREE, SOLID = 0, 1, 2
# A voxel is solid if LEAST_ENDS views end in it, and at most THROUGH times as many see through its centre. It is free
# if LEAST_THROUGH see through it. Of short recordings, one view for every SHORT ones is enough. With 2, 3, 4 and 6
# ends, 70, 73, 75 and 78 percent of the demo's solid voxels lie within one voxel of its surface, and 88, 87, 86 and 83
# percent of the surface that several frames see are solid.
LEAST_ENDS, LEAST_THROUGH, SHORT, THROUGH = 4, 2, 16, 2.0
# What is unknown is free this many voxels around the cameras' paths, since someone carried them; what is solid is not,
# but for one voxel.
ROOM = 4
# The grid holds all but this fraction of what the views see, to each side.
LEFT_OUT = 0.002
# Most voxels of a grid. From some 200 bytes each at the peak, they take 6 GB.
MOST_VOXELS = 32_000_000


@dataclass(frozen=True)
class VoxelSpace:
    """Space as voxels.

    Attributes:
        state: (X, Y, Z) uint8, of UNKNOWN, FREE and SOLID.
        voxel: Edge of a voxel [scene units].
        first: (3,) multiple of the edge at which the first voxel begins.
        R_grid_world: (3, 3) rotation of the grid's axes, of which z points up.
    """

    state: NDArray[np.uint8]
    voxel: float
    first: NDArray[np.int64]
    R_grid_world: NDArray[np.float64]

    def index(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the indices (N, 3) of the voxels of points (N, 3) of the world, which may lie outside of the grid."""
        return np.floor(points @ self.R_grid_world.T / self.voxel).astype(np.int64) - self.first

    def at(self, points: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return the states (N,) at points (N, 3) of the world, UNKNOWN outside of the grid."""
        index = self.index(points)
        inside = np.all((index >= 0) & (index < self.state.shape), axis=1)
        states = np.full(len(points), UNKNOWN, np.uint8)
        states[inside] = self.state[tuple(index[inside].T)]
        return states

    def floor(self, below: float) -> float | None:
        """Return the height of the lowest large level surface below a height, in the grid's axes; None without any.

        It is at least half as large as the largest, which may be a table.
        """
        top = (self.state[:, :, :-1] == SOLID) & (self.state[:, :, 1:] == FREE)
        area = top.sum(axis=(0, 1))[: max(int(below / self.voxel) - self.first[2], 0)]
        if not area.any():
            return None
        both = area + np.append(area[1:], 0)  # a surface may lie between two layers
        lowest = int(np.argmax(2 * both >= both.max()))
        return float(self.voxel * (self.first[2] + 0.5 + lowest + area[lowest : lowest + 2].argmax()))


def carved(
    views: Sequence[Placed],
    paths: Sequence[NDArray[np.float64]],
    R_grid_world: NDArray[np.float64],
    voxel: float,
    farthest: float,
) -> VoxelSpace:
    """Carve space with depth maps. The engine must have been started.

    What the cameras passed through is free by definition.

    Args:
        views: Camera, T_camera_world (4, 4) and depth (H, W), 0 where unknown, of each view.
        paths: Each (N, 3) places of a camera, which moved from each to the next in a straight line.
        R_grid_world: (3, 3) rotation of the grid's axes, of which z points up.
        voxel: Edge of the voxels [scene units].
        farthest: Depth beyond which nothing is looked at [scene units].

    Raises:
        ValueError: If there would be more voxels than MOST_VOXELS.
    """
    ends = [_ends(view, farthest) @ R_grid_world.T / voxel for view in views]
    ways = [path @ R_grid_world.T / voxel for path in paths]
    some, way = np.concatenate([end[:: max(len(end) // 2000, 1)] for end in ends]), np.concatenate(ways)
    low, high = np.quantile(some, [LEFT_OUT, 1.0 - LEFT_OUT], axis=0) if len(some) else (way[0], way[0])
    low, high = np.minimum(low, way.min(axis=0)) - ROOM - 1, np.maximum(high, way.max(axis=0)) + ROOM + 2
    if (count := (high - low).prod()) > MOST_VOXELS:
        raise ValueError(f"{count:.3g} voxels are more than {MOST_VOXELS:,}")
    first = np.floor(low).astype(np.int64)
    shape = np.floor(high).astype(np.int64) - first
    passed = np.concatenate([_passed(way) for way in ways])
    hits = np.zeros(shape.prod(), np.int32)
    for end in ends:
        index = np.floor(end).astype(np.int64) - first
        index = index[((index >= 0) & (index < shape)).all(axis=1)]
        hits[np.unique(np.ravel_multi_index(tuple(index.T), tuple(shape)))] += 1
    seen_through = np.zeros(shape, np.int32)
    near = [(camera, T, np.where(depth < farthest, depth, 0.0).astype(np.float32)) for camera, T, depth in views]
    for layer in range(shape[0]):
        grid = np.stack(np.meshgrid([layer], *map(np.arange, shape[1:]), indexing="ij"), axis=-1).reshape(-1, 3)
        centres = voxel * (grid + first + 0.5) @ R_grid_world
        seen_through[layer] = supporting_views(centres, near, 0.5 * voxel)[1].reshape(shape[1:])
    ends, least = (max(min(number, len(views) // SHORT), 1) for number in (LEAST_ENDS, LEAST_THROUGH))
    hit, through = hits.reshape(shape), seen_through
    state = np.where(through >= least, FREE, UNKNOWN).astype(np.uint8)
    state[(hit >= ends) & (through <= THROUGH * hit)] = SOLID
    index = np.floor(passed).astype(np.int64) - first
    around = np.stack(np.meshgrid(*3 * [np.arange(-ROOM, ROOM + 1)]), axis=-1).reshape(-1, 3)
    for step in around[(around**2).sum(axis=1) <= ROOM**2]:
        at = tuple((index + step).T)
        state[at] = np.where((np.abs(step).max() > 1) & (state[at] == SOLID), SOLID, FREE)
    return VoxelSpace(state, voxel, first, R_grid_world)


def reached(space: VoxelSpace, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which voxels (X, Y, Z) are free and connected to those of points (N, 3) of the world by their faces."""
    free = space.state == FREE
    found = np.zeros_like(free)
    index = space.index(points)
    index = index[((index >= 0) & (index < free.shape)).all(axis=1)]
    found[tuple(index.T)] = True
    found &= free
    count = 0
    while count < (count := int(found.sum())):
        # Forth and back along each axis: a line of free voxels is filled at once.
        for axis in range(3):
            lines, passable = np.moveaxis(found, axis, 0), np.moveaxis(free, axis, 0)
            for k in range(1, len(lines)):
                lines[k] |= lines[k - 1] & passable[k]
            for k in range(len(lines) - 2, -1, -1):
                lines[k] |= lines[k + 1] & passable[k]
    return found


def walkable(space: VoxelSpace, points: NDArray[np.float64], floor: float) -> NDArray[np.bool_]:
    """Return where (X, Y, Z) someone may be who walks from points (N, 3) of the world on a level floor.

    It is what is not solid above the floor, in columns of voxels that are more free than solid. In these, what nobody
    saw is taken to be free: a camera at eye height rarely sees the floor before one's feet.
    """
    free, solid = reached(space, points), space.state == SOLID
    ground = int(floor / space.voxel - space.first[2]) + 1
    columns = free[:, :, ground:].sum(axis=2) > solid[:, :, ground:].sum(axis=2)
    open_space = ~solid & columns[:, :, None] & (np.arange(solid.shape[2]) >= ground)
    return reached(replace(space, state=np.where(open_space, FREE, SOLID).astype(np.uint8)), points)


def _ends(view: Placed, farthest: float) -> NDArray[np.float64]:
    """Points (N, 3) of the world at which the pixels of a view end."""
    camera, T, depth = view
    row, column = np.nonzero((depth > 0) & (depth < farthest))
    pixels = np.stack([column + 0.5, row + 0.5], axis=1)
    return (camera.unproject(pixels, depth[row, column]) - T[:3, 3]) @ T[:3, :3]


def _passed(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (M, 3) on a path through points (N, 3), half a voxel apart at most."""
    steps = np.diff(path, axis=0)
    counts = np.ceil(2.0 * np.linalg.norm(steps, axis=1)).astype(np.int64)
    pieces = [a + np.linspace(0.0, 1.0, n + 1)[1:, None] * d for a, d, n in zip(path, steps, counts, strict=False)]
    return np.concatenate([path[:1], *pieces])

"""`OccupancyVoxels`: the Multi-level Occupancy Hash Voxels (MOHV, Section 3.2.3) as a sparse SNode hierarchy."""

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike, NDArray

from fields.backend import refuse_too_many_fields

__all__ = ["OccupancyVoxels"]

LEAF = 8
# Fan-outs a side of the pointer levels above the leaves: 65,536 cells a side for every level of cell sizes.
POINTERS = (32, 16, 16)
SIDE = LEAF * int(np.prod(POINTERS))
MAX_LEVELS = 16


@ti.data_oriented
class OccupancyVoxels:
    """Which places of the world already hold a Gaussian, at `levels` cell sizes `coarsest / 2^l`.

    levels, resolution, coarsest: L, n and S_init of the paper. The finest level covers at least `resolution * coarsest`
    a side around `origin`, a level twice as coarse twice that. Cells are the floor of the offset by the cell size: the
    same width on both sides of the origin, never repeated. A position that a level does not reach is answered by the
    coarser ones.

    SNode tree: three pointer levels over bitmasked leaves of 8^3 cells; the levels of cell sizes lie behind one another
    along the first axis, since every further tree costs address space, of which Taichi 1.7.4 manages the first GB well.
    Memory follows the occupied places.

    A position is asked for with a target size: the levels used are those whose cells are no smaller than it, and
    always the coarsest, so that no target size goes unanswered.
    """

    def __init__(
        self, coarsest: float = 1.0, levels: int = 8, resolution: int = 512, origin: ArrayLike = (0.0, 0.0, 0.0)
    ) -> None:
        if not 1 <= levels <= MAX_LEVELS or resolution < 1 or resolution << (levels - 1) > SIDE:
            raise ValueError(
                f"voxels need 1 to {MAX_LEVELS} levels and resolution * 2^(levels - 1) <= {SIDE}; "
                f"got {levels=}, {resolution=}"
            )
        self.levels = levels
        self.resolution = resolution
        self.settle(coarsest, origin)
        self.occupied = ti.field(ti.u8)
        outer, *inner = POINTERS
        builder = ti.FieldsBuilder()
        node = builder.pointer(ti.ijk, (outer * MAX_LEVELS, outer, outer))
        for fan_out in inner:
            node = node.pointer(ti.ijk, (fan_out,) * 3)
        node.bitmasked(ti.ijk, (LEAF,) * 3).place(self.occupied)
        builder.finalize()
        refuse_too_many_fields(self.occupied)

    def settle(self, coarsest: float, origin: ArrayLike) -> None:
        """Choose the coarsest cell's size and the middle of the extent, while nothing is marked yet."""
        if not coarsest > 0:
            raise ValueError(f"voxels need a positive cell, got {coarsest=}")
        self.coarsest = float(coarsest)
        self.origin = np.array(origin, dtype=np.float64)

    def level_of(self, size: ArrayLike) -> NDArray[np.int32]:
        """The finest level whose cells are at least `size` wide; 0, the coarsest, for sizes beyond all of them."""
        size = np.maximum(np.asarray(size, dtype=np.float64), 1e-300)
        # The slack keeps a size of exactly S_init / 2^l at level l.
        level = np.floor(np.log2(self.coarsest / size) + 1e-9)
        return np.clip(level, 0, self.levels - 1).astype(np.int32)

    def query(self, position: ArrayLike, size: ArrayLike) -> NDArray[np.bool_]:
        """Whether each position (N, 3) is occupied at its target size (N,) or (): AND from the coarsest level."""
        cells, level = self._cells(position, size)
        out = np.zeros(len(cells), dtype=np.uint8)
        if len(cells):
            self._query(cells, level, out)
        return out.astype(bool)

    def update(self, position: ArrayLike, size: ArrayLike) -> None:
        """Mark each position (N, 3) as occupied on the levels from the coarsest to that of its target size."""
        cells, level = self._cells(position, size)
        if len(cells):
            self._update(cells, level)

    def admit(self, position: ArrayLike, size: float) -> NDArray[np.bool_]:
        """Which of the positions (N, 3) may hold a new Gaussian at a target size: the first of each free cell.

        The admitted ones are marked. The order of the batch decides, so that every run decides alike.
        """
        cells, level = self._cells(position, size)
        out = np.zeros(len(cells), dtype=np.uint8)
        if len(cells):
            self._query(cells, level, out)
        free = np.flatnonzero(out == 0)
        at = (cells[free] >> (self.levels - 1 - level[free, None])) + SIDE // 2
        keys = ((at[:, 0] * SIDE + at[:, 1]) * SIDE + at[:, 2]) * self.levels + level[free]
        _, first = np.unique(keys, return_index=True)
        admitted = np.zeros(len(cells), dtype=bool)
        admitted[free[first]] = True
        if len(first):
            self._update(cells[admitted], level[admitted])
        return admitted

    def _cells(self, position: ArrayLike, size: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Cell indices (N, 3) at the finest level, and the finest level (N,) that is asked for and reaches there.

        The level is -1 where not even the coarsest does.
        """
        position = np.asarray(position, dtype=np.float64).reshape(-1, 3)
        finest = self.coarsest / 2 ** (self.levels - 1)
        cells = np.floor(np.clip((position - self.origin) / finest, -1e15, 1e15)).astype(np.int64)
        level = np.broadcast_to(self.level_of(size), len(cells))
        # A level's cells are the finest cells shifted right, so that levels nest exactly.
        reach = np.maximum(cells, -cells - 1).max(axis=1, initial=0)
        too_fine = np.ceil(np.log2((reach + 1) / (SIDE // 2))).clip(0, self.levels)
        return cells, np.minimum(level, self.levels - 1 - too_fine).astype(np.int32)

    @ti.kernel
    def _query(self, cells: ti.types.ndarray(ndim=2), level: ti.types.ndarray(ndim=1), out: ti.types.ndarray(ndim=1)):
        for i in range(level.shape[0]):
            # Level -1 tests nothing: a place that no cell stands for is never free.
            hit = 1
            for k in range(level[i] + 1):
                if self.occupied[self._at(cells, i, k)] == 0:
                    hit = 0
            out[i] = ti.cast(hit, ti.u8)

    @ti.kernel
    def _update(self, cells: ti.types.ndarray(ndim=2), level: ti.types.ndarray(ndim=1)):
        # One thread: a batch is a few thousand points, and activating shared nodes takes locks anyway.
        ti.loop_config(serialize=True)
        for i in range(level.shape[0]):
            for k in range(level[i] + 1):
                self.occupied[self._at(cells, i, k)] = ti.u8(1)

    @ti.func
    def _at(self, cells: ti.template(), i, level):
        """Index of point i's cell of a level in the sparse grid, the origin in the level's middle."""
        shift = ti.cast(self.levels - 1 - level, ti.i64)
        return ti.Vector(
            [
                ti.cast((cells[i, 0] >> shift) + SIDE // 2, ti.i32) + level * SIDE,
                ti.cast((cells[i, 1] >> shift) + SIDE // 2, ti.i32),
                ti.cast((cells[i, 2] >> shift) + SIDE // 2, ti.i32),
            ]
        )

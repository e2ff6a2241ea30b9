"""`OccupancyVoxels`: the Multi-level Occupancy Hash Voxels (MOHV, Section 3.2.3)."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fields.runtime.backend import has_sparse_fields
from fields.runtime.tenancy import Tenant, in_engine, settled
from fields.voxels.bricks import BRICK_BYTES, BRICK_LEVELS, BRICKS, SIDE, WORDS, Bricks, corner_of, places_of_marks
from fields.voxels.hashed_bricks import HashedBricks
from fields.voxels.sparse_bricks import SparseBricks

# Bytes that a word takes while it rests, rounded up: its place and the word itself are 24 bytes before they are packed.
RESTING_BYTES = 8
WORD_BYTES = 24


class RestingBricks:
    """Keeps the marks of regions packed until a cell of the region is asked for.

    All bricks within a region rest together.

    Attributes:
        count: Number of words that rest.
    """

    def __init__(self, bricks: Bricks) -> None:
        self.count = 0
        self._bricks = bricks
        self._packed: dict[int, bytes] = {}

    def clear(self) -> None:
        """Forget all marks that rest."""
        self.count = 0
        self._packed.clear()

    def rest(self, used: NDArray[np.int32]) -> None:
        """Pack the bricks of all regions that hold none of some cells (N, 3) of the finest level."""
        corners = self._bricks.corners()
        in_use = np.unique(self._bricks.regions_of_cells(used))
        idle = corners[~np.isin(self._bricks.regions(corners), in_use)]
        if len(idle):
            places, words = places_of_marks(idle, self._bricks.read(idle))
            self._bricks.remove(idle)
            self.put(places, words)

    def put(self, places: NDArray[np.int32], words: NDArray[np.uint64]) -> None:
        """Pack words (M,) and their places (M, 4) in lexicographic order. No brick of their regions may be in use."""
        if len(words) == 0:
            return
        regions = self._bricks.regions(places[:, :3])
        order = np.argsort(regions, kind="stable")
        first = np.flatnonzero(np.diff(regions[order], prepend=-1))
        for members in np.split(order, first[1:]):
            # Column by column, they pack to less.
            content = places[members].T.tobytes() + words[members].tobytes()
            self._packed[int(regions[members[0]])] = zlib.compress(content, 1)
        self.count += len(words)

    def wake(self, cells: NDArray[np.int32]) -> None:
        """Put the bricks of the regions that hold cells (N, 3) of the finest level back into use."""
        if not self._packed:
            return
        wanted = np.unique(self._bricks.regions_of_cells(cells)).tolist()
        places, words = self._unpacked([self._packed.pop(region) for region in wanted if region in self._packed])
        if len(words):
            self._bricks.write(places, words)
            self.count -= len(words)

    def read(self) -> tuple[NDArray[np.int32], NDArray[np.uint64]]:
        """Return the places (M, 4) of the words that rest, in any order, and the words (M,)."""
        return self._unpacked(list(self._packed.values()))

    @staticmethod
    def _unpacked(packed: list[bytes]) -> tuple[NDArray[np.int32], NDArray[np.uint64]]:
        places, words = [np.zeros((0, 4), dtype=np.int32)], [np.zeros(0, dtype=np.uint64)]
        for content in map(zlib.decompress, packed):
            count = len(content) // WORD_BYTES
            places.append(np.frombuffer(content, np.int32, 4 * count).reshape(4, count).T)
            words.append(np.frombuffer(content, np.uint64, count, 16 * count))
        return np.concatenate(places), np.concatenate(words)


MAX_LEVELS = 15
# Cell indices are clipped to this before the conversion to integers. It is out of range at every level.
FARTHEST = 2.0**31 - 1.0


@in_engine("clear", "rest", "marks", "restore", "query", "update", "bytes_to_mark", "admit")
class OccupancyVoxels(Tenant):
    """Multi-level occupancy voxels: mark where the map already holds Gaussians, at several cell sizes.

    Level l has cells of size `coarsest / 2^l`. A position belongs to the cell floor(offset / cell size), where offset
    is relative to `origin`. The finest level covers at least `resolution * coarsest` per axis around the origin. Beyond
    the range of a level, the next coarser level that covers the position is used.

    Every query has a target size. It uses the levels whose cells are no smaller than the target size, and always the
    coarsest level.

    Cells are nested, and marking a cell also marks the cells that contain it on all coarser levels. The paper's AND
    over the levels, from the coarsest on, is therefore the bit of the finest level used. Marking goes from that level
    to the coarser ones and stops at the first cell that is already marked.

    The bits are stored in bricks of 80 bytes, each of which holds three levels of the same place: as the leaves of a
    sparse SNode hierarchy on the CPU and CUDA (`SparseBricks`), and in a hash table on devices without sparse fields
    (`HashedBricks`). Memory is proportional to the occupied bricks. 300,000 points on the walls of a room 80 coarsest
    cells wide take 22 MB down to the fifth of eight levels, and 148 MB down to the eighth, where no two points share a
    brick. The mapper mostly asks for the fourth and the fifth. Bricks of places that are out of use can `rest`, which
    takes a tenth of it; they are in use again as soon as a position near them is asked for.

    Args:
        coarsest: Size of the coarsest cell [scene units], S_init of the paper.
        levels: Number of levels, L of the paper.
        resolution: Number of coarsest cells per axis that the finest level covers, n of the paper.
        origin: Centre (3,) of the covered volume in the world frame.

    Raises:
        ValueError: If the levels and resolution exceed the range of the bricks, or `coarsest` is not positive.

    Example:
        points = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 2.01]])
        kept = modp_ti.OccupancyVoxels(coarsest=1.0).admit(points, 0.25)  # [True, False]: both are in one cell
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
        with settled(nodes=SparseBricks.NODES if has_sparse_fields() else 0) as self.tenancy:
            self._bricks: Bricks = SparseBricks(levels) if has_sparse_fields() else HashedBricks(levels)
            self._resting = RestingBricks(self._bricks)

    def settle(self, coarsest: float, origin: ArrayLike) -> None:
        """Set the size of the coarsest cell and the centre (3,) of the covered volume. No cell may be marked yet.

        Raises ValueError if `coarsest` is not positive.
        """
        if not coarsest > 0:
            raise ValueError(f"voxels need a positive cell, got {coarsest=}")
        self.coarsest = float(coarsest)
        self.origin = np.array(origin, dtype=np.float64)

    def clear(self) -> None:
        """Remove all marks. The bricks in use stay allocated for later marks nearby."""
        self._bricks.clear()
        self._resting.clear()

    def rest(self, used: ArrayLike) -> None:
        """Pack the marks of places where none of the positions (N, 3) lie. The answers stay the same."""
        self._resting.rest(self._finest(used))

    @property
    def nbytes(self) -> int:
        """Bytes of the bricks, see `BRICK_BYTES` and `RESTING_BYTES`."""
        return self._bricks.count * BRICK_BYTES + self._resting.count * RESTING_BYTES

    def marks(self) -> tuple[NDArray[np.int32], NDArray[np.uint64], NDArray[np.bool_]]:
        """Return all marks, for `restore`.

        Returns:
            Places (M, 4) of the non-zero words, in lexicographic order, the words (M,), and whether each rests (M,).
        """
        corners = self._bricks.corners()
        places, words = places_of_marks(corners, self._bricks.read(corners))
        packed, packed_words = self._resting.read()
        resting = np.repeat([False, True], [len(words), len(packed_words)])
        places, words = np.concatenate([places, packed]), np.concatenate([words, packed_words])
        order = np.lexsort(places.T[::-1])
        return places[order], words[order], resting[order]

    def restore(
        self, places: NDArray[np.int32], words: NDArray[np.uint64], resting: NDArray[np.bool_] | None = None
    ) -> None:
        """Replace all marks by saved ones. The number of levels must be that of the saved voxels.

        Args:
            places: Places (M, 4) from `marks`.
            words: Words (M,) from `marks`.
            resting: Flags (M,) from `marks`; None if none rest.

        Raises:
            ValueError: If the shapes disagree or a place is out of range.
        """
        limit = [BRICKS * self._bricks.stacks, BRICKS, BRICKS, WORDS]
        resting = np.zeros(len(words), dtype=bool) if resting is None else resting.astype(bool)
        if places.shape != (len(words), 4) or words.ndim != 1 or resting.shape != words.shape:
            raise ValueError(f"marks have places {places.shape} and words {words.shape}, expected (M, 4) and (M,)")
        if ((places < 0) | (places >= limit)).any():
            raise ValueError("marks lie outside the voxels")
        self.clear()
        places, words = np.ascontiguousarray(places, dtype=np.int32), np.ascontiguousarray(words, dtype=np.uint64)
        if not resting.all():
            self._bricks.write(places[~resting], words[~resting])
        self._resting.put(places[resting], words[resting])

    def level_of(self, size: ArrayLike) -> NDArray[np.int32]:
        """Return the finest level whose cells are at least `size` wide; 0 if no level has such cells."""
        size = np.maximum(np.asarray(size, dtype=np.float64), 1e-300)
        # The tolerance keeps a size of exactly S_init / 2^l at level l.
        level = np.floor(np.log2(self.coarsest / size) + 1e-9)
        return np.clip(level, 0, self.levels - 1).astype(np.int32)

    def query(self, position: ArrayLike, size: ArrayLike) -> NDArray[np.bool_]:
        """Return whether each position is occupied at its target size.

        Args:
            position: Positions (N, 3) in the world frame.
            size: Target sizes (N,) or () [scene units].

        Returns:
            Flags (N,). Positions outside the range of all levels count as occupied.
        """
        return self._bricks.query(*self._cells(position, size))

    def update(self, position: ArrayLike, size: ArrayLike) -> None:
        """Mark positions as occupied, from the coarsest level down to that of their target sizes, see `query`."""
        self.admit(position, size)

    def bytes_to_mark(self, position: ArrayLike, size: ArrayLike) -> NDArray[np.int64]:
        """Return an upper bound (N,) on the growth of `nbytes` when positions are marked in order, as in `update`.

        A brick counts as new if the coarsest cell of the position in it is unmarked, even if another of its cells is
        marked.
        """
        cells, level = self._cells(position, size)
        cost = np.zeros(len(cells), dtype=np.int64)
        asked = (self.levels - 1 - level) // BRICK_LEVELS
        for stack in range(self._bricks.stacks):
            coarsest = np.full(len(cells), max(self.levels - BRICK_LEVELS * (stack + 1), 0), dtype=np.int32)
            new = np.flatnonzero((stack >= asked) & ~self._bricks.query(cells, coarsest))
            cost[new[np.unique(corner_of(cells[new], stack), axis=0, return_index=True)[1]]] += BRICK_BYTES
        return cost

    def admit(self, position: ArrayLike, size: ArrayLike) -> NDArray[np.bool_]:
        """Admit the first position of each free cell, and mark the admitted positions.

        The result depends only on the order of the batch and is therefore deterministic.

        Args:
            position: Positions (N, 3) in the world frame.
            size: Target sizes (N,) or () [scene units].

        Returns:
            Flags (N,) of the admitted positions.
        """
        return self._bricks.admit(*self._cells(position, size))

    def _cells(self, position: ArrayLike, size: ArrayLike) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Cells (N, 3) of the finest level, which are in use from now on, and the level (N,) of the target size."""
        cells = self._finest(position)
        if np.shape(size) not in ((), (len(cells),)):
            raise ValueError(f"target sizes have shape {np.shape(size)}, expected one number or ({len(cells)},)")
        self._resting.wake(cells)
        level = np.broadcast_to(self.level_of(size), len(cells))
        return cells, np.ascontiguousarray(level)

    def _finest(self, position: ArrayLike) -> NDArray[np.int32]:
        """Cells (N, 3) of the finest level.

        Computed in NumPy, because a kernel's compiler may replace the division by a product that rounds differently.
        """
        position = np.asarray(position, dtype=np.float64)
        if position.ndim != 2 or position.shape[1] != 3:
            raise ValueError(f"positions have shape {position.shape}, expected (N, 3)")
        cells = position - self.origin
        cells /= self.coarsest / 2 ** (self.levels - 1)
        np.floor(cells, out=cells)
        # Unlike clip, fmax maps NaN to a cell that is out of range.
        np.fmin(np.fmax(cells, -FARTHEST, out=cells), FARTHEST, out=cells)
        return cells.astype(np.int32)

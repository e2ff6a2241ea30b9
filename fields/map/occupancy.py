"""`OccupancyVoxels`: the Multi-level Occupancy Hash Voxels (MOHV, Section 3.2.3) as a sparse SNode hierarchy."""
# pyright: reportGeneralTypeIssues=false, reportInvalidTypeForm=false, reportOptionalCall=false

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fields.runtime.backend import on_gpu, program, refuse_too_many_fields
from fields.runtime.engine import ti
from fields.runtime.parallel import HANDED_OUT

__all__ = ["OccupancyVoxels"]

# A brick holds four levels of the same place: 16^3 cells of the finest of them, then 8^3, 4^3 and 2^3, with one bit per
# cell, in words of 4^3 cells. The last word is only one eighth full.
BRICK_LEVELS = 4
BRICK = 2**BRICK_LEVELS
FIRST_WORD = (0, 64, 72, 73)
WORDS = 74
# Fan-outs per axis of the pointer levels above the bricks. They are small at the bottom, where most of a node around a
# surface is empty.
POINTERS = (64, 16, 8, 2, 2)
BRICKS = int(np.prod(POINTERS))
SIDE = BRICK * BRICKS
MAX_LEVELS = 16
# Number of groups of bricks that the CPU processes in parallel in `admit`.
SHARES = 8
# Cell indices are clipped to this before the conversion to integers. It is out of range at every level.
FARTHEST = 2.0**31 - 1.0

CELLS = ti.types.ndarray(dtype=ti.i32, ndim=2)
LEVELS = ti.types.ndarray(dtype=ti.i32, ndim=1)
FLAGS = ti.types.ndarray(dtype=ti.u8, ndim=1)


@ti.data_oriented
class OccupancyVoxels:
    """Multi-level occupancy voxels: mark where the map already holds Gaussians, at several cell sizes.

    Level l has cells of size `coarsest / 2^l`. A position belongs to the cell floor(offset / cell size), where offset
    is relative to `origin`. The finest level covers at least `resolution * coarsest` per axis around the origin. Beyond
    the range of a level, the next coarser level that covers the position is used.

    Every query has a target size. It uses the levels whose cells are no smaller than the target size, and always the
    coarsest level.

    Cells are nested, and marking a cell also marks the cells that contain it on all coarser levels. The paper's AND
    over the levels, from the coarsest on, is therefore the bit of the finest level used. Marking goes from that level
    to the coarser ones and stops at the first cell that is already marked.

    The SNode tree has five pointer levels over bricks of 592 bytes, each of which holds four voxel levels. The bricks
    for further voxel levels follow along the first axis of the same tree, because every additional tree takes address
    space, of which Taichi 1.7.4 handles only the first GB well. Memory is proportional to the occupied bricks. 300,000
    points on the walls of a room 80 coarsest cells wide take 20 MB down to the fourth of eight levels, which the mapper
    uses, and 260 MB down to the eighth, where no two points share a brick.

    Args:
        coarsest: Size of the coarsest cell [scene units], S_init of the paper.
        levels: Number of levels, L of the paper.
        resolution: Number of coarsest cells per axis that the finest level covers, n of the paper.
        origin: Centre (3,) of the covered volume in the world frame.

    Raises:
        ValueError: If the levels and resolution exceed the range of the tree, or `coarsest` is not positive.

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
        program()
        self.levels = levels
        self.resolution = resolution
        self.settle(coarsest, origin)
        self.words = ti.field(ti.u64)
        outer, *inner = POINTERS
        builder = ti.FieldsBuilder()
        node = builder.pointer(ti.ijk, (outer * -(-levels // BRICK_LEVELS), outer, outer))
        for fan_out in inner:
            node = node.pointer(ti.ijk, (fan_out,) * 3)
        node.dense(ti.l, WORDS).place(self.words)
        self._bricks = node
        self._next = ti.field(ti.i32)
        builder.place(self._next)
        builder.finalize()
        refuse_too_many_fields(self.words)

    def settle(self, coarsest: float, origin: ArrayLike) -> None:
        """Set the size of the coarsest cell and the centre of the covered volume. No cell may be marked yet.

        Args:
            coarsest: Size of the coarsest cell [scene units].
            origin: Centre (3,) in the world frame.

        Raises:
            ValueError: If `coarsest` is not positive.
        """
        if not coarsest > 0:
            raise ValueError(f"voxels need a positive cell, got {coarsest=}")
        self.coarsest = float(coarsest)
        self.origin = np.array(origin, dtype=np.float64)

    def clear(self) -> None:
        """Remove all marks. The bricks stay allocated for later marks nearby."""
        self._clear()

    @property
    def nbytes(self) -> int:
        """Bytes of the allocated bricks."""
        return self._count_bricks() * WORDS * 8

    def marks(self) -> tuple[NDArray[np.int32], NDArray[np.uint64]]:
        """Return all marks, for `restore`.

        Returns:
            Places (M, 4) of the non-zero words, in lexicographic order, and the words (M,).
        """
        count = self._count_bricks()
        corners, words = np.zeros((count, 3), dtype=np.int32), np.zeros((count, WORDS), dtype=np.uint64)
        if count:
            self._next[None] = 0
            self._read_bricks(corners, words)
        brick, word = np.nonzero(words)
        places = np.column_stack([corners[brick], word]).astype(np.int32)
        order = np.lexsort(places.T[::-1])
        return places[order], words[brick, word][order]

    def restore(self, places: NDArray[np.int32], words: NDArray[np.uint64]) -> None:
        """Replace all marks by saved ones. The number of levels must be that of the saved voxels.

        Args:
            places: Places (M, 4) from `marks`.
            words: Words (M,) from `marks`.

        Raises:
            ValueError: If the shapes disagree or a place is out of range.
        """
        limit = [BRICKS * -(-self.levels // BRICK_LEVELS), BRICKS, BRICKS, WORDS]
        if places.shape != (len(words), 4) or words.ndim != 1:
            raise ValueError(f"marks have places {places.shape} and words {words.shape}, expected (M, 4) and (M,)")
        if ((places < 0) | (places >= limit)).any():
            raise ValueError("marks lie outside the voxels")
        self._clear()
        if len(words):
            places = np.ascontiguousarray(places, dtype=np.int32)
            self._write_words(places, np.ascontiguousarray(words, dtype=np.uint64))

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
        cells, level = self._cells(position, size)
        out = np.empty(len(cells), dtype=np.uint8)
        self._query(cells, level, out)
        return out.astype(bool)

    def update(self, position: ArrayLike, size: ArrayLike) -> None:
        """Mark each position as occupied, from the coarsest level down to that of its target size.

        Args:
            position: Positions (N, 3) in the world frame.
            size: Target sizes (N,) or () [scene units].
        """
        self.admit(position, size)

    def bytes_to_mark(self, position: ArrayLike, size: ArrayLike) -> NDArray[np.int64]:
        """Return an upper bound (N,) on the growth of `nbytes` when the positions are marked in order.

        A brick counts as new if the coarsest cell of the position in it is unmarked, even if another of its cells is
        marked.

        Args:
            position: Positions (N, 3) in the world frame.
            size: Target sizes (N,) or () [scene units].
        """
        cells, level = self._cells(position, size)
        cost = np.zeros(len(cells), dtype=np.int64)
        asked = (self.levels - 1 - level) // BRICK_LEVELS
        for stack in range(-(-self.levels // BRICK_LEVELS)):
            coarsest = np.full(len(cells), max(self.levels - BRICK_LEVELS * (stack + 1), 0), dtype=np.int32)
            marked = np.empty(len(cells), dtype=np.uint8)
            self._query(cells, coarsest, marked)
            new = np.flatnonzero((stack >= asked) & (marked == 0))
            bricks = cells[new] >> (BRICK_LEVELS * (stack + 1))
            cost[new[np.unique(bricks, axis=0, return_index=True)[1]]] += WORDS * 8
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
        cells, level = self._cells(position, size)
        if on_gpu():
            return self._admit_together(cells, level)
        out = np.empty(len(cells), dtype=np.uint8)
        self._admit(cells, level, out)
        return out.astype(bool)

    def _admit_together(self, cells: NDArray[np.int32], level: NDArray[np.int32]) -> NDArray[np.bool_]:
        """`admit` on a GPU, in parallel over the points of each run of equal levels.

        Within one level, a point is only affected by earlier points of its own cell, so the first point represents the
        cell. The batch is split where the level changes.
        """
        admitted = np.zeros(len(cells), dtype=bool)
        cuts = np.flatnonzero(np.diff(level)) + 1
        for run in np.split(np.arange(len(cells)), cuts):
            if len(run) == 0:
                continue
            # Beyond the range of its level, a point is represented by its cell on the coarser level that is used.
            depth = self._depth_reached(cells[run], level[run])
            place = np.column_stack([cells[run] >> depth[:, None], depth])
            first = run[np.sort(np.unique(place, axis=0, return_index=True)[1])]
            occupied = np.empty(len(first), dtype=np.uint8)
            self._query(cells[first], level[first], occupied)
            free = first[occupied == 0]
            if len(free):
                self._mark(cells[free], level[free])
            admitted[free] = True
        return admitted

    def _depth_reached(self, cells: NDArray[np.int32], level: NDArray[np.int32]) -> NDArray[np.int32]:
        """`_reached` on the host: depth (N,), in levels above the finest, of the first level that covers each cell."""
        depth = self.levels - 1 - level
        reach = np.maximum(cells, -1 - cells).max(axis=1)
        for _ in range(-(-self.levels // BRICK_LEVELS)):
            stack = depth & -BRICK_LEVELS
            beyond = (depth < self.levels) & ((reach >> stack) >= SIDE // 2)
            depth = np.where(beyond, stack + BRICK_LEVELS, depth)
        return depth

    def _cells(self, position: ArrayLike, size: ArrayLike) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Cells (N, 3) of the finest level, and the level (N,) of the target size.

        Computed in NumPy, because a kernel's compiler may replace the division by a product that rounds differently.
        """
        position = np.asarray(position, dtype=np.float64)
        if position.ndim != 2 or position.shape[1] != 3:
            raise ValueError(f"positions have shape {position.shape}, expected (N, 3)")
        if np.shape(size) not in ((), (len(position),)):
            raise ValueError(f"target sizes have shape {np.shape(size)}, expected one number or ({len(position)},)")
        cells = position - self.origin
        cells /= self.coarsest / 2 ** (self.levels - 1)
        np.floor(cells, out=cells)
        # Unlike clip, fmax maps NaN to a cell that is out of range.
        np.fmin(np.fmax(cells, -FARTHEST, out=cells), FARTHEST, out=cells)
        level = np.broadcast_to(self.level_of(size), len(cells))
        return cells.astype(np.int32), np.ascontiguousarray(level)

    @ti.kernel
    def _clear(self):
        # Loop over bricks, since a struct-for over the words skips some of them (Taichi 1.7.4).
        for i, j, k in self._bricks:
            for word in range(WORDS):
                self.words[i, j, k, word] = ti.u64(0)

    @ti.kernel
    def _count_bricks(self) -> ti.i32:
        count = 0
        for _i, _j, _k in self._bricks:
            count += 1
        return count

    @ti.kernel
    def _read_bricks(
        self, corners: ti.types.ndarray(dtype=ti.i32, ndim=2), words: ti.types.ndarray(dtype=ti.u64, ndim=2)
    ):
        for i, j, k in self._bricks:
            row = ti.atomic_add(self._next[None], 1)
            corners[row, 0], corners[row, 1], corners[row, 2] = i, j, k
            for word in range(WORDS):
                words[row, word] = self.words[i, j, k, word]

    @ti.kernel
    def _write_words(self, places: CELLS, words: ti.types.ndarray(dtype=ti.u64, ndim=1)):
        for m in range(words.shape[0]):
            self.words[places[m, 0], places[m, 1], places[m, 2], places[m, 3]] = words[m]

    @ti.kernel
    def _query(self, cells: CELLS, level: LEVELS, out: FLAGS):
        for i in range(level.shape[0]):
            cell = ti.Vector([cells[i, 0], cells[i, 1], cells[i, 2]])
            depth = self._reached(cell, level[i])
            # A cell that no level covers counts as occupied.
            occupied = 1
            if depth < self.levels:
                word, bit, _ = self._at(cell, depth)
                occupied = (self.words[word] & bit) != ti.u64(0)
            out[i] = ti.cast(occupied, ti.u8)

    @ti.kernel
    def _admit(self, cells: CELLS, level: LEVELS, out: FLAGS):
        # A point depends only on earlier points in its brick of the coarsest levels. Groups of bricks therefore run in
        # parallel, and each group goes through the batch in order.
        for spread in range(SHARES * HANDED_OUT):
            if spread % HANDED_OUT == 0:
                for i in range(level.shape[0]):
                    cell = ti.Vector([cells[i, 0], cells[i, 1], cells[i, 2]])
                    if self._share(cell) == spread // HANDED_OUT:
                        out[i] = self._admit_one(cell, level[i])

    @ti.kernel
    def _mark(self, cells: CELLS, level: LEVELS):
        for i in range(level.shape[0]):
            self._admit_one(ti.Vector([cells[i, 0], cells[i, 1], cells[i, 2]]), level[i])

    @ti.func
    def _share(self, cell):
        """Group of a cell, the same for all cells in a brick of the coarsest levels."""
        brick = cell >> ti.static(BRICK_LEVELS * -(-self.levels // BRICK_LEVELS))
        return (brick[0] + 3 * brick[1] + 5 * brick[2]) & (SHARES - 1)

    @ti.func
    def _admit_one(self, cell, level):
        asked = self._reached(cell, level)
        depth = asked
        while depth < self.levels:
            word, bit, siblings = self._at(cell, depth)
            # An atomic, so that one walk down the tree both reads and writes the word.
            marked = ti.atomic_or(self.words[word], bit)
            if marked & bit:
                break
            depth += 1
            # If a sibling is marked, so are the parent and all coarser cells.
            if marked & siblings:
                break
        return ti.cast(depth > asked, ti.u8)

    @ti.func
    def _reached(self, cell, level):
        """Depth, in levels above the finest, of the first level from `level` up that covers a cell; L if none does."""
        depth = self.levels - 1 - level
        reach = ti.max(cell, -1 - cell).max()
        # The four levels of a brick cover the same range.
        while depth < self.levels and (reach >> (depth & -BRICK_LEVELS)) >= SIDE // 2:
            depth = (depth & -BRICK_LEVELS) + BRICK_LEVELS
        return depth

    @ti.func
    def _at(self, cell, depth):
        """Index of the word of a cell at a depth, its bit there, and the bits of all eight cells of its parent."""
        # Shifts, since floor division of signed integers takes many instructions.
        stack = depth >> 2
        within = depth & (BRICK_LEVELS - 1)
        brick = (cell >> ((stack + 1) * BRICK_LEVELS)) + BRICKS // 2
        inside = (cell >> depth) & ((BRICK >> within) - 1)
        first = 0
        for k in ti.static(range(1, BRICK_LEVELS)):
            first = ti.select(within == k, FIRST_WORD[k], first)
        words = ti.max(BRICK_LEVELS - 2 - within, 0)  # log2 of the words per axis
        word = ((inside[0] >> 2) << (2 * words)) + ((inside[1] >> 2) << words) + (inside[2] >> 2)
        bit = ((inside[0] & 3) << 4) + ((inside[1] & 3) << 2) + (inside[2] & 3)
        place = ti.Vector([brick[0] + stack * BRICKS, brick[1], brick[2], first + word])
        even = bit & 0b101010  # the sibling with even coordinates: the first of the 2^3 bits
        return place, ti.u64(1) << ti.cast(bit, ti.u64), ti.u64(0x330033) << ti.cast(even, ti.u64)

"""`OccupancyVoxels`: the Multi-level Occupancy Hash Voxels (MOHV, Section 3.2.3) as a sparse SNode hierarchy."""

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike, NDArray

from fields.runtime.backend import on_gpu, program, refuse_too_many_fields
from fields.runtime.parallel import HANDED_OUT

__all__ = ["OccupancyVoxels"]

# A brick holds four levels of the same place: 16^3 cells of the finest of them, then 8^3, 4^3 and 2^3, a bit a cell, in
# words of 4^3 cells (the last is filled by an eighth).
BRICK_LEVELS = 4
BRICK = 2**BRICK_LEVELS
FIRST_WORD = (0, 64, 72, 73)
WORDS = 74
# Fan-outs a side of the pointer levels above the bricks; small ones at the bottom, where surfaces leave nodes empty.
POINTERS = (64, 16, 8, 2, 2)
BRICKS = int(np.prod(POINTERS))
SIDE = BRICK * BRICKS
MAX_LEVELS = 16
# Shares of the world that are admitted to at the same time.
SHARES = 8
# Cells are clipped to this before they become integers; no level reaches it.
FARTHEST = 2.0**31 - 1.0

CELLS = ti.types.ndarray(dtype=ti.i32, ndim=2)
LEVELS = ti.types.ndarray(dtype=ti.i32, ndim=1)
FLAGS = ti.types.ndarray(dtype=ti.u8, ndim=1)


@ti.data_oriented
class OccupancyVoxels:
    """Which places of the world already hold a Gaussian, at `levels` cell sizes `coarsest / 2^l`.

    levels, resolution, coarsest: L, n and S_init of the paper. The finest level covers at least `resolution * coarsest`
    a side around `origin`. Cells are the floor of the offset by the cell size: the same width on both sides of the
    origin, never repeated. A position that a level does not reach is answered by the coarser ones.

    A position is asked for with a target size: the levels used are those whose cells are no smaller than it, and
    always the coarsest, so that no target size goes unanswered.

    Cells nest, and a cell is never marked without those around it on the coarser levels. The AND of the paper over the
    levels from the coarsest is therefore the bit of the finest level asked for, and marking goes from there to the
    coarser levels, until one is marked already.

    SNode tree: five pointer levels over bricks of four levels each (592 bytes), the stacks of four levels behind one
    another along the first axis, since every further tree costs address space, of which Taichi 1.7.4 manages the
    first GB well. Memory follows the occupied places: 300,000 points on the walls of a room 80 coarsest cells wide take
    20 MB down to the fourth of eight levels, where the mapper asks, and 260 MB down to the eighth, where no two points
    share a brick.
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
        """Choose the coarsest cell's size and the middle of the extent, while nothing is marked yet."""
        if not coarsest > 0:
            raise ValueError(f"voxels need a positive cell, got {coarsest=}")
        self.coarsest = float(coarsest)
        self.origin = np.array(origin, dtype=np.float64)

    def clear(self) -> None:
        """Forget all marks. The memory of the places stays, for those around them."""
        self._clear()

    @property
    def nbytes(self) -> int:
        """Bytes of the marks."""
        return self._count_bricks() * WORDS * 8

    def marks(self) -> tuple[NDArray[np.int32], NDArray[np.uint64]]:
        """All marks: places (M, 4) of words that have any, in their order, and the words (M,). For `restore`."""
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
        """Replace all marks by those that `marks` gave, of voxels with as many levels.

        Raises ValueError for places that there are not.
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
        """The finest level whose cells are at least `size` wide; 0, the coarsest, for sizes beyond all of them."""
        size = np.maximum(np.asarray(size, dtype=np.float64), 1e-300)
        # The slack keeps a size of exactly S_init / 2^l at level l.
        level = np.floor(np.log2(self.coarsest / size) + 1e-9)
        return np.clip(level, 0, self.levels - 1).astype(np.int32)

    def query(self, position: ArrayLike, size: ArrayLike) -> NDArray[np.bool_]:
        """Whether each position (N, 3) is occupied at its target size (N,) or (): AND from the coarsest level."""
        cells, level = self._cells(position, size)
        out = np.empty(len(cells), dtype=np.uint8)
        self._query(cells, level, out)
        return out.astype(bool)

    def update(self, position: ArrayLike, size: ArrayLike) -> None:
        """Mark each position (N, 3) as occupied on the levels from the coarsest to that of its target size."""
        self.admit(position, size)

    def bytes_to_mark(self, position: ArrayLike, size: ArrayLike) -> NDArray[np.int64]:
        """Upper bound (N,) on the bytes that `nbytes` grows by when each position is marked after those before it.

        A brick counts as new if the position's coarsest cell in it is not marked, though another of its cells may be.
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
        """Which of the positions (N, 3) may hold a new Gaussian at target size (N,) or (): the first of each free cell.

        The admitted ones are marked. The order of the batch decides, so that every run decides alike.
        """
        cells, level = self._cells(position, size)
        if on_gpu():
            return self._admit_together(cells, level)
        out = np.empty(len(cells), dtype=np.uint8)
        self._admit(cells, level, out)
        return out.astype(bool)

    def _admit_together(self, cells: NDArray[np.int32], level: NDArray[np.int32]) -> NDArray[np.bool_]:
        """`admit` on a GPU, whose threads are many and slow one by one: a level at a time, each in parallel.

        Points of one level are answered by those before them only in their own cell, so that the first of each cell
        stands for it. Of different levels, the batch is cut where the level changes.
        """
        admitted = np.zeros(len(cells), dtype=bool)
        cuts = np.flatnonzero(np.diff(level)) + 1
        for run in np.split(np.arange(len(cells)), cuts):
            if len(run) == 0:
                continue
            # Where the asked level does not reach, a coarser one answers: its cell is what a point stands for.
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
        """`_reached` on the host: depth (N,), in levels above the finest, of the first level that reaches each cell."""
        depth = self.levels - 1 - level
        reach = np.maximum(cells, -1 - cells).max(axis=1)
        for _ in range(-(-self.levels // BRICK_LEVELS)):
            stack = depth & -BRICK_LEVELS
            beyond = (depth < self.levels) & ((reach >> stack) >= SIDE // 2)
            depth = np.where(beyond, stack + BRICK_LEVELS, depth)
        return depth

    def _cells(self, position: ArrayLike, size: ArrayLike) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Cells (N, 3) of the finest level, and the level (N,) that is asked for.

        Here and not in a kernel, where the compiler may replace the division by a product that rounds otherwise.
        """
        position = np.asarray(position, dtype=np.float64)
        if position.ndim != 2 or position.shape[1] != 3:
            raise ValueError(f"positions have shape {position.shape}, expected (N, 3)")
        if np.shape(size) not in ((), (len(position),)):
            raise ValueError(f"target sizes have shape {np.shape(size)}, expected one number or ({len(position)},)")
        cells = position - self.origin
        cells /= self.coarsest / 2 ** (self.levels - 1)
        np.floor(cells, out=cells)
        # fmax and not clip: a NaN becomes a place beyond reach.
        np.fmin(np.fmax(cells, -FARTHEST, out=cells), FARTHEST, out=cells)
        level = np.broadcast_to(self.level_of(size), len(cells))
        return cells.astype(np.int32), np.ascontiguousarray(level)

    @ti.kernel
    def _clear(self):
        # Over bricks: a loop over the words themselves passes some by (Taichi 1.7.4).
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
            # A place that no level reaches is never free.
            occupied = 1
            if depth < self.levels:
                word, bit, _ = self._at(cell, depth)
                occupied = (self.words[word] & bit) != ti.u64(0)
            out[i] = ti.cast(occupied, ti.u8)

    @ti.kernel
    def _admit(self, cells: CELLS, level: LEVELS, out: FLAGS):
        # A point is answered by those before it, but only by those in its brick of the coarsest levels.
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
        """Which share a cell belongs to: the same for all in a brick of the coarsest levels."""
        brick = cell >> ti.static(BRICK_LEVELS * -(-self.levels // BRICK_LEVELS))
        return (brick[0] + 3 * brick[1] + 5 * brick[2]) & (SHARES - 1)

    @ti.func
    def _admit_one(self, cell, level):
        asked = self._reached(cell, level)
        depth = asked
        while depth < self.levels:
            word, bit, siblings = self._at(cell, depth)
            # Atomic only to walk down the tree once for reading and writing.
            marked = ti.atomic_or(self.words[word], bit)
            if marked & bit:
                break
            depth += 1
            # A sibling has marked the parent.
            if marked & siblings:
                break
        return ti.cast(depth > asked, ti.u8)

    @ti.func
    def _reached(self, cell, level):
        """Depth, in levels above the finest, of the first from `level` up that reaches the cell; L where none does."""
        depth = self.levels - 1 - level
        reach = ti.max(cell, -1 - cell).max()
        # The four levels of a brick reach equally far.
        while depth < self.levels and (reach >> (depth & -BRICK_LEVELS)) >= SIDE // 2:
            depth = (depth & -BRICK_LEVELS) + BRICK_LEVELS
        return depth

    @ti.func
    def _at(self, cell, depth):
        """Index of the word of a cell at a depth, its bit there, and the bits of all eight cells of its parent."""
        # Shifts: the floor division of signed numbers is many instructions.
        stack = depth >> 2
        within = depth & (BRICK_LEVELS - 1)
        brick = (cell >> ((stack + 1) * BRICK_LEVELS)) + BRICKS // 2
        inside = (cell >> depth) & ((BRICK >> within) - 1)
        first = 0
        for k in ti.static(range(1, BRICK_LEVELS)):
            first = ti.select(within == k, FIRST_WORD[k], first)
        words = ti.max(BRICK_LEVELS - 2 - within, 0)  # log2 of the words a side
        word = ((inside[0] >> 2) << (2 * words)) + ((inside[1] >> 2) << words) + (inside[2] >> 2)
        bit = ((inside[0] & 3) << 4) + ((inside[1] & 3) << 2) + (inside[2] & 3)
        place = ti.Vector([brick[0] + stack * BRICKS, brick[1], brick[2], first + word])
        even = bit & 0b101010  # the sibling with even coordinates: the first of the 2^3 bits
        return place, ti.u64(1) << ti.cast(bit, ti.u64), ti.u64(0x330033) << ti.cast(even, ti.u64)

"""`SparseBricks`: bricks of the occupancy voxels as the leaves of a sparse SNode hierarchy, on the CPU and CUDA."""
# pyright: reportGeneralTypeIssues=false, reportInvalidTypeForm=false, reportOptionalCall=false

import numpy as np
from numpy.typing import NDArray

from fields.runtime.backend import on_gpu, refuse_too_many_fields, sparse
from fields.runtime.compiled_kernel import HANDED_OUT
from fields.runtime.engine import ti
from fields.voxels.bricks import (
    BRICK_LEVELS,
    BRICKS,
    WORDS,
    Bricks,
    depth_reached,
    place_of,
    without_repetitions,
)

# Fan-outs per axis of the pointer levels above the bricks. They are small at the bottom, where most of a node around a
# surface is empty.
POINTERS = (32, 4, 4, 4, 4, 2, 2, 2)
assert np.prod(POINTERS) == BRICKS
# Number of groups of bricks that the CPU processes in parallel in `admit`.
SHARES = 8

CELLS = ti.types.ndarray(dtype=ti.i32, ndim=2)
LEVELS = ti.types.ndarray(dtype=ti.i32, ndim=1)
FLAGS = ti.types.ndarray(dtype=ti.u8, ndim=1)


@ti.data_oriented
class SparseBricks(Bricks):
    """Bricks of 64-bit words below eight pointer levels.

    The stacks share one tree, because every additional tree takes address space, of which Taichi 1.7.4 handles only the
    first GB well.

    On CUDA, a node must not be activated in the launch that writes below it. The engine reads the pointers of a node
    through the multiprocessor's own cache, which may still hold that of a node without children; the write then goes to
    the element that stands for all inactive ones. On an H100, 3 of 2,265 words were lost so, and other bricks seemed to
    be marked. Hence the bricks of a batch are activated before, level by level.
    """

    NODES = len(POINTERS)

    def __init__(self, levels: int) -> None:
        super().__init__(levels)
        self.words = ti.field(ti.u64)
        outer, *inner = POINTERS
        builder = ti.FieldsBuilder()
        self._nodes = [sparse(builder, ti.ijk, (outer * self.stacks, outer, outer))]
        for fan_out in inner:
            self._nodes.append(sparse(self._nodes[-1], ti.ijk, (fan_out,) * 3))
        self._bricks = self._nodes[-1]
        self._bricks.dense(ti.l, WORDS).place(self.words)
        self._next = ti.field(ti.i32)
        builder.place(self._next)
        builder.finalize()
        refuse_too_many_fields(self.words)

    @property
    def count(self) -> int:
        return self._count()

    def clear(self) -> None:
        self._clear()

    def corners(self) -> NDArray[np.int32]:
        corners = np.zeros((self.count, 3), dtype=np.int32)
        if len(corners):
            self._next[None] = 0
            self._list(corners)
        return corners

    def read(self, corners: NDArray[np.int32]) -> NDArray[np.uint64]:
        words = np.zeros((len(corners), WORDS), dtype=np.uint64)
        self._read(corners, words)
        return words

    def remove(self, corners: NDArray[np.int32]) -> None:
        places = []
        for node in range(len(POINTERS)):
            width = int(np.prod(POINTERS[node + 1 :]))  # of what lies below a pointer of the node [bricks]
            # The nodes above those that lie within the region stay.
            within = width <= 1 << BRICK_LEVELS * (self.stacks - 1 - corners[:, 0] // BRICKS)
            nodes = without_repetitions(corners[within] // width)
            places.append(np.column_stack([nodes, np.full(len(nodes), node)]))
        self._deactivate(np.concatenate(places).astype(np.int32))

    def write(self, places: NDArray[np.int32], words: NDArray[np.uint64]) -> None:
        if on_gpu():
            self._activate(without_repetitions(places[:, :3]))
        self._write(places, words)

    def query(self, cells: NDArray[np.int32], level: NDArray[np.int32]) -> NDArray[np.bool_]:
        out = np.empty(len(cells), dtype=np.uint8)
        self._query(cells, level, out)
        return out.astype(bool)

    def mark(self, cells: NDArray[np.int32], level: NDArray[np.int32]) -> None:
        if on_gpu():
            self._activate(without_repetitions(self.corners_to_mark(cells, level)))
        self._mark(cells, level)

    def admit(self, cells: NDArray[np.int32], level: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Mark the first point of each free cell, in order, and return which those are (N,).

        On the CPU, groups of bricks run in parallel, each point after point.
        """
        if on_gpu():
            return super().admit(cells, level)
        out = np.empty(len(cells), dtype=np.uint8)
        self._admit(cells, level, out)
        return out.astype(bool)

    @ti.kernel
    def _clear(self):
        # Loop over bricks, since a struct-for over the words skips some of them (Taichi 1.7.4).
        for i, j, k in self._bricks:
            for word in range(WORDS):
                self.words[i, j, k, word] = ti.u64(0)

    @ti.kernel
    def _count(self) -> ti.i32:
        count = 0
        for _i, _j, _k in self._bricks:
            count += 1
        return count

    @ti.kernel
    def _list(self, corners: CELLS):
        for i, j, k in self._bricks:
            row = ti.atomic_add(self._next[None], 1)
            corners[row, 0], corners[row, 1], corners[row, 2] = i, j, k

    @ti.kernel
    def _read(self, corners: CELLS, words: ti.types.ndarray(dtype=ti.u64, ndim=2)):
        for row in range(corners.shape[0]):
            for word in range(WORDS):
                words[row, word] = self.words[corners[row, 0], corners[row, 1], corners[row, 2], word]

    @ti.kernel
    def _activate(self, corners: CELLS):
        # Each loop is a launch of its own, so that a level sees the nodes of the level above.
        for node in ti.static(range(len(POINTERS))):
            for i in range(corners.shape[0]):
                corner = ti.Vector([corners[i, 0], corners[i, 1], corners[i, 2]])
                ti.activate(self._nodes[node], corner // ti.static(int(np.prod(POINTERS[node + 1 :]))))

    @ti.kernel
    def _deactivate(self, places: CELLS):
        # A loop for each level, because a node's memory is only given back if those below it have been.
        for node in ti.static(range(len(POINTERS) - 1, -1, -1)):
            for m in range(places.shape[0]):
                if places[m, 3] == node:
                    ti.deactivate(self._nodes[node], ti.Vector([places[m, 0], places[m, 1], places[m, 2]]))

    @ti.kernel
    def _write(self, places: CELLS, words: ti.types.ndarray(dtype=ti.u64, ndim=1)):
        for m in range(words.shape[0]):
            self.words[places[m, 0], places[m, 1], places[m, 2], places[m, 3]] = words[m]

    @ti.kernel
    def _query(self, cells: CELLS, level: LEVELS, out: FLAGS):
        for i in range(level.shape[0]):
            cell = ti.Vector([cells[i, 0], cells[i, 1], cells[i, 2]])
            depth = depth_reached(cell, level[i], self.levels)
            # A cell that no level covers counts as occupied.
            occupied = 1
            if depth < self.levels:
                place, bit, _ = self._at(cell, depth)
                occupied = (self.words[place] & bit) != ti.u64(0)
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
        brick = cell >> ti.static(BRICK_LEVELS * self.stacks)
        return (brick[0] + 3 * brick[1] + 5 * brick[2]) & (SHARES - 1)

    @ti.func
    def _admit_one(self, cell, level):
        asked = depth_reached(cell, level, self.levels)
        depth = asked
        while depth < self.levels:
            place, bit, siblings = self._at(cell, depth)
            # An atomic, so that one walk down the tree both reads and writes the word.
            marked = ti.atomic_or(self.words[place], bit)
            if marked & bit:
                break
            depth += 1
            # If a sibling is marked, so are the parent and all coarser cells.
            if marked & siblings:
                break
        return ti.cast(depth > asked, ti.u8)

    @ti.func
    def _at(self, cell, depth):
        """Index of the word of a cell at a depth, its bit there, and the bits of all eight cells of its parent."""
        corner, word, bit = place_of(cell, depth)
        even = bit & 0b101010  # the sibling with even coordinates: the first of the 2^3 bits
        place = ti.Vector([corner[0], corner[1], corner[2], word])
        return place, ti.u64(1) << ti.cast(bit, ti.u64), ti.u64(0x330033) << ti.cast(even, ti.u64)

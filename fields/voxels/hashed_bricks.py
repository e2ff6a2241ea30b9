"""`HashedBricks`: bricks of the occupancy voxels in a hash table, for devices without sparse fields (Vulkan, Metal)."""
# pyright: reportGeneralTypeIssues=false, reportInvalidTypeForm=false, reportOptionalCall=false

import numpy as np
from numpy.typing import NDArray

from fields.runtime.engine import dense_array, ti
from fields.voxels.bricks import WORDS, Bricks, depth_reached, numbered, place_of, places_of_marks, without_repetitions

# Number of bricks that there is room for at first.
FIRST_ROOM = 1 << 12
# Number of bricks that one launch inserts: drivers end a launch that takes seconds, and one thread inserts them all.
MOST_INSERTED = 1 << 14
# A place of the table without a brick.
EMPTY = -1

ROWS = ti.types.ndarray(dtype=ti.i32, ndim=1)
CORNERS = ti.types.ndarray(dtype=ti.i32, ndim=2)
HALVES = ti.types.ndarray(dtype=ti.u32, ndim=2)


class HashedBricks(Bricks):
    """Bricks in rows of a dense array, found through a hash table with open addressing.

    Brick number r has its corner in row r of `_corners` and its words in row r of `_halves`, each as two halves of 32
    bits, because many of these devices have no atomic operations on 64 bits. `_table` has two places for each row and
    holds row numbers: a brick is at the hash of its corner, or after it without a gap. All three are dense arrays that
    are passed to the kernels, so that they can grow between launches without compiling a kernel again.
    """

    def __init__(self, levels: int) -> None:
        super().__init__(levels)
        self._count = 0
        self._allocate(FIRST_ROOM)

    @property
    def count(self) -> int:
        return self._count

    def clear(self) -> None:
        self._halves.fill(0)

    def corners(self) -> NDArray[np.int32]:
        return self._corners.to_numpy()[: self._count]

    def read(self, corners: NDArray[np.int32]) -> NDArray[np.uint64]:
        every = numbered(self.corners())
        order = np.argsort(every)
        halves = self._halves.to_numpy()[order[np.searchsorted(every, numbered(corners), sorter=order)]]
        return halves[:, 0::2] | halves[:, 1::2].astype(np.uint64) << np.uint64(32)

    def remove(self, corners: NDArray[np.int32]) -> None:
        every = self.corners()
        kept = every[~np.isin(numbered(every), numbered(corners))]
        words = self.read(kept)
        self._count = 0
        self._allocate(max(FIRST_ROOM, 1 << max(len(kept) - 1, 0).bit_length()))
        self._add(kept)
        self.write(*places_of_marks(kept, words))

    def write(self, places: NDArray[np.int32], words: NDArray[np.uint64]) -> None:
        self._add(places[:, :3])
        halves = np.stack([words & np.uint64(0xFFFFFFFF), words >> np.uint64(32)], axis=1).astype(np.uint32)
        _write(self._table, self._corners, self._halves, places, halves)

    def query(self, cells: NDArray[np.int32], level: NDArray[np.int32]) -> NDArray[np.bool_]:
        out = np.empty(len(cells), dtype=np.int32)
        _query(self._table, self._corners, self._halves, self.levels, cells, level, out)
        return out.astype(bool)

    def mark(self, cells: NDArray[np.int32], level: NDArray[np.int32]) -> None:
        self._add(self.corners_to_mark(cells, level))
        _mark(self._table, self._corners, self._halves, self.levels, cells, level)

    def _add(self, corners: NDArray[np.int32]) -> None:
        """Allocate the bricks with these corners (N, 3) that are not allocated yet."""
        corners = without_repetitions(corners)
        missing = np.empty(len(corners), dtype=np.int32)
        _find_missing(self._table, self._corners, corners, missing)
        corners = corners[missing != 0]
        if self._count + len(corners) > self._corners.shape[0]:
            self._grow(self._count + len(corners))
        self._insert(corners, self._count)
        self._count += len(corners)

    def _grow(self, count: int) -> None:
        """Make room for `count` bricks at least. Allocated bricks keep their rows."""
        corners, halves = self._corners.to_numpy()[: self._count], self._halves
        self._allocate(1 << (count - 1).bit_length())
        _copy(halves, self._halves)
        self._insert(corners, 0)

    def _insert(self, corners: NDArray[np.int32], first: int) -> None:
        """Add bricks, none of which is in the table, as the rows from `first` on."""
        for start in range(0, max(len(corners), 1), MOST_INSERTED):
            _insert(self._table, self._corners, corners[start : start + MOST_INSERTED], first + start)

    def _allocate(self, room: int) -> None:
        self._table = dense_array(ti.i32, (2 * room,))
        self._table.fill(EMPTY)
        self._corners = dense_array(ti.i32, (room, 3))
        self._halves = dense_array(ti.u32, (room, 2 * WORDS))


@ti.func
def _hashed(corner, table: ti.template()):
    """Place of the table at which the search for a brick begins. The table's size is a power of two."""
    mixed = ti.cast(corner[0], ti.u32) * ti.u32(0x9E3779B1)
    mixed ^= ti.cast(corner[1], ti.u32) * ti.u32(0x85EBCA77)
    mixed ^= ti.cast(corner[2], ti.u32) * ti.u32(0xC2B2AE3D)
    mixed = (mixed ^ (mixed >> 15)) * ti.u32(0x2C1B3C6D)
    return ti.cast(mixed ^ (mixed >> 13), ti.i32) & (table.shape[0] - 1)


@ti.func
def _found(corner, table: ti.template(), corners: ti.template()):
    """Row of a brick; EMPTY if it is not allocated."""
    place = _hashed(corner, table)
    row = table[place]
    while row != EMPTY:
        if corners[row, 0] == corner[0] and corners[row, 1] == corner[1] and corners[row, 2] == corner[2]:
            break
        place = (place + 1) & (table.shape[0] - 1)
        row = table[place]
    return row


@ti.kernel
def _find_missing(table: ROWS, corners: CORNERS, asked: CORNERS, missing: ROWS):
    for i in range(asked.shape[0]):
        row = _found(ti.Vector([asked[i, 0], asked[i, 1], asked[i, 2]]), table, corners)
        missing[i] = ti.cast(row == EMPTY, ti.i32)


@ti.kernel
def _insert(table: ROWS, corners: CORNERS, added: CORNERS, first: ti.i32):
    # One thread for all, since Taichi has no compare-and-swap.
    for _ in range(1):
        for i in range(added.shape[0]):
            corner = ti.Vector([added[i, 0], added[i, 1], added[i, 2]])
            for axis in ti.static(range(3)):
                corners[first + i, axis] = corner[axis]
            place = _hashed(corner, table)
            while table[place] != EMPTY:
                place = (place + 1) & (table.shape[0] - 1)
            table[place] = first + i


@ti.kernel
def _copy(source: HALVES, target: HALVES):
    for i, k in source:
        target[i, k] = source[i, k]


@ti.kernel
def _write(table: ROWS, corners: CORNERS, halves: HALVES, places: CORNERS, words: HALVES):
    for m in range(places.shape[0]):
        row = _found(ti.Vector([places[m, 0], places[m, 1], places[m, 2]]), table, corners)
        for half in ti.static(range(2)):
            halves[row, 2 * places[m, 3] + half] = words[m, half]


@ti.kernel
def _query(table: ROWS, corners: CORNERS, halves: HALVES, levels: ti.i32, cells: CORNERS, level: ROWS, marked: ROWS):
    for i in range(level.shape[0]):
        cell = ti.Vector([cells[i, 0], cells[i, 1], cells[i, 2]])
        depth = depth_reached(cell, level[i], levels)
        marked[i] = 1
        if depth < levels:
            corner, word, bit = place_of(cell, depth)
            row = _found(corner, table, corners)
            marked[i] = 0
            if row != EMPTY:
                marked[i] = ti.cast((halves[row, 2 * word + (bit >> 5)] >> ti.cast(bit & 31, ti.u32)) & 1, ti.i32)


@ti.kernel
def _mark(table: ROWS, corners: CORNERS, halves: HALVES, levels: ti.i32, cells: CORNERS, level: ROWS):
    # One thread for each cell and depth, because atomics in a loop that threads leave at different times lose their
    # results on Mesa's software driver.
    for thread in range(level.shape[0] * levels):
        i, depth = thread // levels, thread % levels
        cell = ti.Vector([cells[i, 0], cells[i, 1], cells[i, 2]])
        if depth >= depth_reached(cell, level[i], levels):
            corner, word, bit = place_of(cell, depth)
            row = _found(corner, table, corners)
            ti.atomic_or(halves[row, 2 * word + (bit >> 5)], ti.u32(1) << ti.cast(bit & 31, ti.u32))

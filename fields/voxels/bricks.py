"""The layout of the occupancy voxels' bricks, and `Bricks`, the storage of their words.

A brick holds three levels of the same place: 8^3 cells of the finest of them, then 4^3 and 2^3, with one bit per cell,
in words of 4^3 cells. The last word is only one eighth full. A depth counts levels above the finest, and three depths
make a stack. The bricks of further stacks follow along the first axis, so that the corner of a brick, three integers,
tells its stack as well.
"""
# pyright: reportGeneralTypeIssues=false, reportInvalidTypeForm=false, reportOptionalCall=false

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from fields.runtime.engine import ti

BRICK_LEVELS = 3
BRICK = 2**BRICK_LEVELS
FIRST_WORD = (0, 8, 9)
WORDS = 10
# Bytes that a brick takes, with its share of the nodes above it or of the hash table: 230 to 445 in a sparse tree.
BRICK_BYTES = 256
# Bricks per axis, for each stack.
BRICKS = 1 << 16
SIDE = BRICK * BRICKS


@ti.func
def depth_reached(cell, level, levels):
    """Depth of the first level from `level` up that covers a cell; `levels` if none does."""
    depth = levels - 1 - level
    reach = ti.max(cell, -1 - cell).max()
    # The levels of a brick cover the same range.
    first = depth - ti.raw_mod(depth, BRICK_LEVELS)
    while depth < levels and (reach >> first) >= SIDE // 2:
        first += BRICK_LEVELS
        depth = first
    return depth


@ti.func
def place_of(cell, depth):
    """Place of a cell at a depth: the corner of its brick, and its word and bit there."""
    # Shifts and raw division, since floor division of signed integers takes many instructions.
    stack = ti.raw_div(depth, BRICK_LEVELS)
    within = depth - stack * BRICK_LEVELS
    brick = (cell >> ((stack + 1) * BRICK_LEVELS)) + BRICKS // 2
    inside = (cell >> depth) & ((BRICK >> within) - 1)
    first = 0
    for k in ti.static(range(1, BRICK_LEVELS)):
        first = ti.select(within == k, FIRST_WORD[k], first)
    words = ti.max(BRICK_LEVELS - 2 - within, 0)  # log2 of the words per axis
    word = ((inside[0] >> 2) << (2 * words)) + ((inside[1] >> 2) << words) + (inside[2] >> 2)
    bit = ((inside[0] & 3) << 4) + ((inside[1] & 3) << 2) + (inside[2] & 3)
    return ti.Vector([brick[0] + stack * BRICKS, brick[1], brick[2]]), first + word, bit


def corner_of(cells: NDArray[np.int32], stack: int) -> NDArray[np.int32]:
    """Corners (N, 3) of the bricks of a stack that hold cells (N, 3) of the finest level."""
    corners = (cells >> ((stack + 1) * BRICK_LEVELS)) + BRICKS // 2
    corners[:, 0] += stack * BRICKS
    return corners


def without_repetitions(corners: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return each of the bricks' corners (N, 3) once, in lexicographic order."""
    key = np.unique(numbered(corners))  # three times faster than unique rows
    return np.stack([key >> 32, (key >> 16) & 0xFFFF, key & 0xFFFF], axis=1).astype(np.int32)


def numbered(corners: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return one number (N,) for each brick's corner (N, 3), in lexicographic order."""
    x, y, z = corners.astype(np.int64).T
    return (x << 32) | (y << 16) | z


def places_of_marks(
    corners: NDArray[np.int32], words: NDArray[np.uint64]
) -> tuple[NDArray[np.int32], NDArray[np.uint64]]:
    """Return the places (M, 4) of the non-zero words of bricks, in lexicographic order, and these words (M,).

    The bricks are given by their corners (B, 3), each once, and their words (B, 10).
    """
    order = np.argsort(numbered(corners))
    corners, words = corners[order], words[order]
    brick, word = np.nonzero(words)
    return np.column_stack([corners[brick], word]).astype(np.int32), words[brick, word]


class Bricks(ABC):
    """Storage of the bricks that have been marked. `clear` leaves them allocated.

    Space is divided into regions, the cubes of the coarsest stack's bricks. They have numbers.

    Cells (N, 3) are those of the finest level, and `level` (N,) is the level that is asked for; beyond its range, the
    first coarser level that covers the cell is used.

    Args:
        levels: Number of levels.
    """

    def __init__(self, levels: int) -> None:
        self.levels = levels
        self.stacks = -(-levels // BRICK_LEVELS)

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of allocated bricks."""

    @abstractmethod
    def clear(self) -> None:
        """Remove all marks."""

    @abstractmethod
    def corners(self) -> NDArray[np.int32]:
        """Return the corners (B, 3) of the allocated bricks, in any order."""

    @abstractmethod
    def read(self, corners: NDArray[np.int32]) -> NDArray[np.uint64]:
        """Return the words (B, 10) of allocated bricks, given by their corners (B, 3)."""

    @abstractmethod
    def remove(self, corners: NDArray[np.int32]) -> None:
        """Deallocate bricks, given by their corners (B, 3). All bricks of a region go together."""

    @abstractmethod
    def write(self, places: NDArray[np.int32], words: NDArray[np.uint64]) -> None:
        """Set words (M,) at their places (M, 4): the brick's corner and the word in the brick."""

    @abstractmethod
    def query(self, cells: NDArray[np.int32], level: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Return whether each cell is marked (N,). A cell that no level covers counts as marked."""

    @abstractmethod
    def mark(self, cells: NDArray[np.int32], level: NDArray[np.int32]) -> None:
        """Mark each cell, from its level up to the coarsest. All cells lie in the range of some level."""

    def admit(self, cells: NDArray[np.int32], level: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Mark the first point of each free cell, in order, and return which those are (N,).

        Points of equal level are processed in parallel. Within one level, a point is only affected by earlier points of
        its own cell, so the first point represents the cell. The batch is split where the level changes.
        """
        admitted = np.zeros(len(cells), dtype=bool)
        cuts = np.flatnonzero(np.diff(level)) + 1
        for run in np.split(np.arange(len(cells)), cuts):
            # Beyond the range of its level, a point is represented by its cell on the coarser level that is used.
            depth = self.depth_reached(cells[run], level[run])
            place = np.column_stack([cells[run] >> depth[:, None], depth])
            first = run[np.sort(np.unique(place, axis=0, return_index=True)[1])]
            free = first[~self.query(cells[first], level[first])]
            self.mark(cells[free], level[free])
            admitted[free] = True
        return admitted

    def regions(self, corners: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return the region (B,) of each brick, given by its corner (B, 3)."""
        stack = corners[:, 0] // BRICKS
        place = corners - BRICKS // 2
        place[:, 0] -= stack * BRICKS
        return _region_numbers(place >> (BRICK_LEVELS * (self.stacks - 1 - stack))[:, None])

    def regions_of_cells(self, cells: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return the region of each cell (N,). Cells out of range are in regions without bricks."""
        return _region_numbers(np.clip(cells >> (BRICK_LEVELS * self.stacks), -BRICKS // 2 - 1, BRICKS // 2))

    def corners_to_mark(self, cells: NDArray[np.int32], level: NDArray[np.int32]) -> NDArray[np.int32]:
        """Corners (B, 3) of all bricks that `mark` writes to, with repetitions."""
        first = self.depth_reached(cells, level) // BRICK_LEVELS
        return np.concatenate([corner_of(cells[first <= stack], stack) for stack in range(self.stacks)])

    def depth_reached(self, cells: NDArray[np.int32], level: NDArray[np.int32]) -> NDArray[np.int32]:
        """The function `depth_reached` on the host: the depth (N,) of the level that is used for each cell."""
        depth = self.levels - 1 - level
        reach = np.maximum(cells, -1 - cells).max(axis=1)
        for _ in range(self.stacks):
            first = depth - depth % BRICK_LEVELS
            beyond = (depth < self.levels) & ((reach >> first) >= SIDE // 2)
            depth = np.where(beyond, first + BRICK_LEVELS, depth)
        return depth


def _region_numbers(regions: NDArray[np.int32]) -> NDArray[np.int64]:
    """One number (N,) for each three integers (N, 3) from -2^16 to 2^16 - 1."""
    x, y, z = regions.astype(np.int64).T + BRICKS
    return (x << 34) | (y << 17) | z

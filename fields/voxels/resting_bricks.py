"""`RestingBricks`: marks of the occupancy voxels at places that are out of use, packed."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from fields.voxels.bricks import Bricks, places_of_marks

# Bytes that a word takes while it rests, rounded up: its place and the word itself are 24 bytes before they are packed.
RESTING_BYTES = 8
WORD_BYTES = 24


class RestingBricks:
    """Keeps the marks of regions packed until a cell of the region is asked for.

    All bricks within a region rest together.

    Args:
        bricks: The bricks in use.

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

"""`RowsOfIds`: rows of a table by id, in few bytes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

# Number of the latest ids that are kept in a dictionary, at least, and their largest share of all.
RECENT = 4096
SHARE = 1 / 8


class RowsOfIds:
    """Numbers ids in the order in which they come: the first is row 0.

    An id takes 16 bytes, and not the 65 of a dictionary, which holds the latest ones only.

    Args:
        ids: The ids so far, each once.
    """

    def __init__(self, ids: NDArray[np.int64] | Sequence[int] = ()) -> None:
        self._ids = np.array(ids, dtype=np.int64)
        self._order = np.argsort(self._ids)
        self._recent: dict[int, int] = {}  # rows of the ids after these

    def __len__(self) -> int:
        return len(self._ids) + len(self._recent)

    @property
    def ids(self) -> NDArray[np.int64]:
        """The ids (N,) in the order of their rows."""
        return np.concatenate([self._ids, np.fromiter(self._recent, np.int64, len(self._recent))])

    def find(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the rows (N,) of ids; -1 for those that have none."""
        rows = np.full(len(ids), -1, dtype=np.int64)
        if len(self._ids):
            place = np.searchsorted(self._ids, ids, sorter=self._order)
            found = self._order[np.minimum(place, len(self._ids) - 1)]
            rows = np.where(self._ids[found] == ids, found, rows)
        others = np.flatnonzero(rows < 0)
        rows[others] = [self._recent.get(i, -1) for i in ids[others].tolist()]
        return rows

    def take(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the rows (N,) of ids, after those that had none have got the next ones."""
        rows = self.find(ids)
        others = np.flatnonzero(rows < 0)
        rows[others] = [self._recent.setdefault(i, len(self)) for i in ids[others].tolist()]
        if len(self._recent) > max(RECENT, SHARE * len(self)):
            self._ids, self._recent = self.ids, {}
            self._order = np.argsort(self._ids)
        return rows

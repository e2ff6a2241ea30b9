"""View selection: the current, local and global keyframes of an optimisation step (Section 3.3.2)."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fields.map.keyframes import KeyframeStore
from pipelines.select.keyframes import SeenPoints, covisibility
from pipelines.settings import ViewSettings


class ViewSelection(Protocol):
    """Protocol of a policy that selects the views of an optimisation step."""

    def begin(self, store: KeyframeStore, near: NDArray[np.int64]) -> None:
        """Called before the steps on a new keyframe, which is the last of `store`.

        Args:
            store: The keyframes.
            near: Places (M,) of those around it, see `Paging.near`.
        """
        ...

    def select(self, store: KeyframeStore) -> list[int]:
        """Return the indices into `store` of the views of the next step, the current keyframe first."""
        ...


def global_probabilities(
    store: KeyframeStore,
    error_weight: float,
    recency_weight: float,
    among: NDArray[np.int64],
    recovery: float = 0.0,
) -> NDArray[np.float64]:
    """Probabilities (N,) of keyframes in the draw of global views (Eq. 2).

    p(j) is proportional to exp(error_weight err(j)) exp(recency_weight (j - last)) (err(j) / best(j))^recovery. The
    last factor is no part of the paper.

    Args:
        store: The keyframes.
        error_weight: Weight of the errors.
        recency_weight: Weight of the places.
        among: Places (N,) of the keyframes that may be drawn.
        recovery: Weight of how far a keyframe has fallen below its own best.
    """
    exponent = error_weight * store.errors()[among] + recency_weight * (among - (len(store) - 1))
    if recovery:
        exponent += recovery * store.sinking()[among]
    p = np.exp(exponent - exponent.max())
    return p / p.sum()


class LocalGlobalViews:
    """Selects the latest keyframe, up to `local_views` recent ones and `global_views` from all keyframes.

    Keyframes that see too much of what lies on disk are left out (`Paging.near`).

    Local views come from a bank of the latest keyframes before the current one. They are drawn without replacement,
    in proportion to their covisibility with the current view. Global views are drawn by Eq. 2. Both draws are repeated
    at every step.
    """

    def __init__(self, settings: ViewSettings, rng: np.random.Generator) -> None:
        self.settings = settings
        self._rng = rng
        self._bank: list[int] = []
        self._overlap = np.zeros(0)
        self._near = np.zeros(0, dtype=np.int64)

    def begin(self, store: KeyframeStore, near: NDArray[np.int64]) -> None:
        last = store.latest
        self._near = near
        self._bank = [int(j) for j in near if last - self.settings.bank <= j < last]
        current = SeenPoints.of(store[last])
        self._overlap = np.array([covisibility(current, SeenPoints.of(store[j])) for j in self._bank])

    def select(self, store: KeyframeStore) -> list[int]:
        last = store.latest
        views = [last]
        if self._bank and self.settings.local_views:
            n = min(self.settings.local_views, len(self._bank))
            p = self._overlap + 1e-6
            views += list(self._rng.choice(self._bank, n, replace=False, p=p / p.sum()))
        if len(store) > 1 and len(self._near) and self.settings.global_views:
            p = global_probabilities(store, self.settings.error_weight, self.settings.recency_weight, self._near)
            views += list(self._rng.choice(self._near, self.settings.global_views, p=p))
        return [int(v) for v in views]

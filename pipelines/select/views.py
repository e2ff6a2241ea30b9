"""View selection: the current, local and global keyframes of an optimisation step (Section 3.3.2)."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from fields.map.covisibility import SeenPoints, covisibility
from fields.map.keyframes import KeyframeStore
from pipelines.settings import ViewSettings

__all__ = ["LocalGlobalViews", "ViewSelection", "global_probabilities"]


class ViewSelection(Protocol):
    """Protocol of a policy that selects the views of an optimisation step."""

    def begin(self, store: KeyframeStore) -> None:
        """Called before the steps on a new keyframe, which is the last of `store`."""
        ...

    def select(self, store: KeyframeStore) -> list[int]:
        """Return the indices into `store` of the views of the next step, the current keyframe first."""
        ...


def global_probabilities(store: KeyframeStore, error_weight: float, recency_weight: float) -> np.ndarray:
    """Probabilities (N,) of all keyframes in the draw of global views (Eq. 2).

    p(j) is proportional to exp(error_weight err(j)) exp(recency_weight (j - last)).
    """
    exponent = error_weight * store.errors() + recency_weight * (np.arange(len(store)) - (len(store) - 1))
    p = np.exp(exponent - exponent.max())
    return p / p.sum()


class LocalGlobalViews:
    """Selects the latest keyframe, up to `local_views` recent ones and `global_views` from all keyframes.

    Local views come from a bank of the latest keyframes before the current one. They are drawn without replacement,
    in proportion to their covisibility with the current view. Global views are drawn by Eq. 2. Both draws are repeated
    at every step.
    """

    def __init__(self, settings: ViewSettings, rng: np.random.Generator) -> None:
        self.settings = settings
        self._rng = rng
        self._bank: list[int] = []
        self._overlap = np.zeros(0)

    def begin(self, store: KeyframeStore) -> None:
        last = store.latest
        self._bank = list(range(max(0, last - self.settings.bank), last))
        current = SeenPoints.of(store[last])
        self._overlap = np.array([covisibility(current, SeenPoints.of(store[j])) for j in self._bank])

    def select(self, store: KeyframeStore) -> list[int]:
        last = store.latest
        views = [last]
        if self._bank and self.settings.local_views:
            n = min(self.settings.local_views, len(self._bank))
            p = self._overlap + 1e-6
            views += list(self._rng.choice(self._bank, n, replace=False, p=p / p.sum()))
        if len(store) > 1 and self.settings.global_views:
            p = global_probabilities(store, self.settings.error_weight, self.settings.recency_weight)
            views += list(self._rng.choice(len(store), self.settings.global_views, p=p))
        return [int(v) for v in views]

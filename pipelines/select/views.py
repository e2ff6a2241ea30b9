"""Which keyframes an optimisation step looks at: the current one, local ones and global ones (Section 3.3.2)."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from fields.map.keyframes import KeyframeStore
from pipelines.select.keyframes import SeenPoints, covisibility
from pipelines.settings import ViewSettings

__all__ = ["LocalGlobalViews", "ViewSelection", "global_probabilities"]


class ViewSelection(Protocol):
    """A policy that names the views of a step."""

    def begin(self, store: KeyframeStore) -> None:
        """A new keyframe, the last of `store`, is about to be optimised."""

    def select(self, store: KeyframeStore) -> list[int]:
        """Indices into `store` of the views of the next step, the current keyframe first."""


def global_probabilities(store: KeyframeStore, error_weight: float, recency_weight: float) -> np.ndarray:
    """Eq. 2: p(j) ~ exp(error_weight err(j)) exp(recency_weight (j - last)) over all keyframes (N,)."""
    exponent = error_weight * store.errors() + recency_weight * (np.arange(len(store)) - (len(store) - 1))
    p = np.exp(exponent - exponent.max())
    return p / p.sum()


class LocalGlobalViews:
    """1 current + `local_views` from the bank of latest keyframes + `global_views` from all of them.

    The bank holds the latest keyframes before the current one; its draw is in proportion to their covisibility with
    the current view. Global views are drawn by Eq. 2, anew at every step.
    """

    def __init__(self, settings: ViewSettings, rng: np.random.Generator) -> None:
        self.settings = settings
        self._rng = rng
        self._bank: list[int] = []
        self._overlap = np.zeros(0)

    def begin(self, store: KeyframeStore) -> None:
        last = len(store) - 1
        self._bank = list(range(max(0, last - self.settings.bank), last))
        current = SeenPoints.of(store[last])
        self._overlap = np.array([covisibility(current, SeenPoints.of(store[j])) for j in self._bank])

    def select(self, store: KeyframeStore) -> list[int]:
        last = len(store) - 1
        views = [last]
        if self._bank and self.settings.local_views:
            n = min(self.settings.local_views, len(self._bank))
            p = self._overlap + 1e-6
            views += list(self._rng.choice(self._bank, n, replace=False, p=p / p.sum()))
        if last and self.settings.global_views:
            p = global_probabilities(store, self.settings.error_weight, self.settings.recency_weight)
            views += list(self._rng.choice(len(store), self.settings.global_views, p=p))
        return [int(v) for v in views]

"""Which pairs of images are matched: neighbours in time, and images that look alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modp_ti.inputs.multiview.appearance import Appearance
from modp_ti.inputs.multiview.features import Features

__all__ = ["image_pairs"]

# Up to this number of images, all pairs are matched.
ALL_PAIRS = 60
# Images that look most like an image, which are matched with it: beside its neighbours in a sequence, where they close
# loops, and alone.
ALIKE_IN_SEQUENCE, ALIKE = 8, 30


def image_pairs(features: Sequence[Features], overlap: int | None, seed: int) -> list[tuple[int, int]]:
    """Choose the pairs of images that are matched.

    Args:
        features: Features of each image.
        overlap: Number of next images in a sequence that an image is matched with, besides those 2, 4, 8, ... images
            later. None for images in no order.
        seed: Seed of the vocabulary.

    Returns:
        Ascending pairs (i, j) with i < j.
    """
    count = len(features)
    if count <= ALL_PAIRS:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    pairs: set[tuple[int, int]] = set()
    if overlap is not None:
        apart = sorted({*range(1, overlap + 1), *(1 << k for k in range(count.bit_length()))})
        pairs |= {(i, i + step) for i in range(count) for step in apart if i + step < count}
    likeness = Appearance(features, seed).likeness().astype(np.float64)
    index = np.arange(count)
    near = np.abs(index[:, None] - index) <= (0 if overlap is None else overlap)
    likeness[near] = -np.inf  # neighbours would take the places of those that close a loop
    alike = np.argsort(-likeness, axis=1, kind="stable")[:, : ALIKE if overlap is None else ALIKE_IN_SEQUENCE]
    pairs |= {(min(i, int(j)), max(i, int(j))) for i in range(count) for j in alike[i] if not near[i, j]}
    return sorted(pairs)

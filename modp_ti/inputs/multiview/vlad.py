"""VLAD: one vector for an image, from its local features and a vocabulary of visual words [Jegou et al. 2010]."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["nearest_words", "vlad"]


def vlad(descriptors: NDArray[np.uint8], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """Descriptor (count * 128,) of an image from its features (N, 128); zero without features.

    The residuals of each word have length 1 in it, so that repeated structure does not dominate.
    """
    if len(descriptors) == 0 or len(words) == 0:
        return np.zeros(words.size, np.float32)
    data = descriptors.astype(np.float32)
    nearest = nearest_words(data, words)
    member = np.zeros((len(words), len(data)), np.float32)
    member[nearest, np.arange(len(data))] = 1.0
    residual = member @ data - member.sum(axis=1, keepdims=True) * words  # of integers, and so exact
    residual /= np.maximum(np.linalg.norm(residual, axis=1, keepdims=True), 1e-12)
    vector = residual.reshape(-1)
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def nearest_words(data: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.int64]:
    """The nearest word of each descriptor."""
    return ((words * words).sum(axis=1) - 2.0 * (data @ words.T)).argmin(axis=1)

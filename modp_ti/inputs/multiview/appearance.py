"""`Appearance`: finds the images that resemble a picture, by one vector per image (VLAD, Jegou 2010)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.multiview.features import Features
from modp_ti.inputs.multiview.vlad import vlad

__all__ = ["Appearance"]

# Words of the vocabulary, and the most descriptors that it is trained with. On redkitchen, 16, 32 and 64 words find the
# same views.
WORDS = 32
TRAINED_WITH = 20_000
ITERATIONS = 15


class Appearance:
    """A vocabulary of visual words, and a vector for each image.

    The vocabulary is trained with the features of the images themselves. The vector of an image sums, for each word,
    the differences from the word of the descriptors that are nearest to it.

    Args:
        features: Features of each image.
        seed: Seed of the training.
    """

    def __init__(self, features: Sequence[Features], seed: int = 0) -> None:
        described = np.concatenate([image.descriptors for image in features]).astype(np.float32)
        chosen = np.random.default_rng(seed).permutation(len(described))[:TRAINED_WITH]
        self._words = _clustered(described[np.sort(chosen)], seed)
        self._vectors = np.stack([vlad(image.descriptors, self._words) for image in features])

    def alike(self, features: Features, count: int) -> list[int]:
        """Return the indices of the `count` images most similar to a picture with these features, best first."""
        likeness = self._vectors @ vlad(features.descriptors, self._words)
        return [int(k) for k in np.argsort(-likeness, kind="stable")[:count]]

    def likeness(self) -> NDArray[np.float32]:
        """Return the likeness (N, N) of all pairs of images, from -1 to 1."""
        return self._vectors @ self._vectors.T


def _clustered(described: NDArray[np.float32], seed: int) -> NDArray[np.float32]:
    """At most `WORDS` centres (K, 128) of the descriptors by k-means."""
    count = min(WORDS, len(described))
    if count == 0:
        return np.zeros((1, 128), np.float32)
    cv2.setRNGSeed(seed)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER, ITERATIONS, 0.0)
    _, _, centres = cv2.kmeans(described, count, np.zeros((0, 1), np.int32), criteria, 1, cv2.KMEANS_PP_CENTERS)
    # Rounded, since the threads of k-means may sum in another order.
    return np.round(np.asarray(centres, np.float32))

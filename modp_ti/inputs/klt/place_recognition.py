"""Recognition of places by appearance: keyframes are compared by a descriptor of the whole image.

The descriptor is VLAD [Jegou et al. 2010] over RootSIFT, with a vocabulary from the recording's own features.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.klt.landmark_map import Keyframe
from modp_ti.inputs.klt.relocalisation import described_keyframe
from modp_ti.inputs.multiview.vlad import nearest_words, vlad

__all__ = ["PlaceIndex"]

WORDS = 64
TRAINED_ON = 20_000  # descriptors, at most
ROUNDS = 12  # of k-means


class PlaceIndex:
    """Image descriptors of keyframes.

    The vocabulary is learned when it is first needed, and again when there are twice as many keyframes.

    Args:
        seed: Seed of the vocabulary.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._words = np.zeros((0, 128), np.float32)
        self._trained_on = 0  # keyframes
        self._vectors: dict[int, NDArray[np.float32]] = {}  # by number of the keyframe

    def likeness(self, keyframe: Keyframe, others: Sequence[Keyframe]) -> NDArray[np.float32]:
        """Cosines (N,) between the descriptor of a keyframe and those of N others."""
        self._train([keyframe, *others])
        mine = self._vector(keyframe)
        return np.array([self._vector(other) @ mine for other in others], np.float32)

    def _vector(self, keyframe: Keyframe) -> NDArray[np.float32]:
        vector = self._vectors.get(keyframe.number)
        if vector is None:
            vector = self._vectors[keyframe.number] = vlad(described_keyframe(keyframe).descriptors, self._words)
        return vector

    def _train(self, keyframes: Sequence[Keyframe]) -> None:
        if len(keyframes) < 2 * self._trained_on:
            return
        rows = [described_keyframe(keyframe).descriptors for keyframe in keyframes]
        stride = max(1, -(-sum(map(len, rows)) // TRAINED_ON))
        self._words = vocabulary(np.concatenate(rows)[::stride], WORDS, self._seed)
        self._trained_on = len(keyframes)
        self._vectors.clear()


def vocabulary(descriptors: NDArray[np.uint8], count: int, seed: int) -> NDArray[np.float32]:
    """Cluster centres (count, 128) of descriptors (N, 128), rounded to integers; fewer if there are few descriptors."""
    count = min(count, len(descriptors))
    if count == 0:
        return np.zeros((0, 128), np.float32)
    data = descriptors.astype(np.float32)
    start = data[np.random.default_rng(seed).choice(len(data), count, replace=False)]
    labels = nearest_words(data, start).astype(np.int32)
    # With initial labels and one attempt, the result does not depend on OpenCV's own random numbers.
    criteria = (cv2.TERM_CRITERIA_MAX_ITER, ROUNDS, 0.0)
    _, _, centres = cv2.kmeans(data, count, labels, criteria, 1, cv2.KMEANS_USE_INITIAL_LABELS)
    return np.rint(np.asarray(centres, np.float32))

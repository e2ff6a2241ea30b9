"""Images that resemble each other, by one vector per image (VLAD, Jegou 2010)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.multiview.features import Features

# Words of the vocabulary, and the most descriptors that it is trained with. On redkitchen, 16, 32 and 64 words find the
# same views.
WORDS = 32
TRAINED_WITH = 20_000
ROUNDS = 12  # of k-means
# Up to this number of images, all pairs are matched.
ALL_PAIRS = 60
# Images that look most like an image, which are matched with it: beside its neighbours in a sequence, where they close
# loops, and alone.
ALIKE_IN_SEQUENCE, ALIKE = 8, 30


class Appearance:
    """A vocabulary of visual words, and a vector for each image.

    The vocabulary is trained with the features of the images themselves. The vector of an image sums, for each word,
    the differences from the word of the descriptors that are nearest to it.

    Args:
        features: Features of each image.
        seed: Seed of the training.
    """

    def __init__(self, features: Sequence[Features], seed: int = 0) -> None:
        described = np.concatenate([image.descriptors for image in features])
        chosen = np.random.default_rng(seed).permutation(len(described))[:TRAINED_WITH]
        self._words = vocabulary(described[np.sort(chosen)], WORDS, seed)
        self._vectors = np.stack([vlad(image.descriptors, self._words) for image in features])

    def alike(self, features: Features, count: int) -> list[int]:
        """Return the indices of the `count` images most similar to a picture with these features, best first."""
        likeness = self._vectors @ vlad(features.descriptors, self._words)
        return [int(k) for k in np.argsort(-likeness, kind="stable")[:count]]

    def likeness(self) -> NDArray[np.float32]:
        """Return the likeness (N, N) of all pairs of images, from -1 to 1."""
        return self._vectors @ self._vectors.T


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


def image_pairs(
    features: Sequence[Features], overlap: int | None, seed: int, cameras: int = 1
) -> list[tuple[int, int]]:
    """Choose the pairs of images that are matched.

    Args:
        features: Features of each image.
        overlap: Number of next images in a sequence that an image is matched with, besides those 2, 4, 8, ... images
            later. None for images in no order.
        seed: Seed of the vocabulary.
        cameras: Number of cameras of a rig, whose images follow one another. In a sequence, an image is then matched
            with the next ones of its own camera, and with those of any that look alike.

    Returns:
        Ascending pairs (i, j) with i < j.
    """
    count = len(features)
    index = np.arange(count)
    apart = np.abs(index[:, None] // cameras - index // cameras)
    if count <= ALL_PAIRS:
        return [(i, j) for i, j in np.argwhere(np.triu(apart > 0)).tolist()]
    pairs: set[tuple[int, int]] = set()
    if overlap is not None:
        steps = sorted({*range(1, overlap + 1), *(1 << k for k in range(count.bit_length()))})
        pairs |= {(i, i + step * cameras) for i in range(count) for step in steps if i + step * cameras < count}
    likeness = Appearance(features, seed).likeness().astype(np.float64)
    # Neighbours would take the places of those that close a loop.
    near = (apart == 0) | ((apart <= (overlap or 0)) & ((index[:, None] - index) % cameras == 0))
    likeness[near] = -np.inf
    alike = np.argsort(-likeness, axis=1, kind="stable")[:, : ALIKE if overlap is None else ALIKE_IN_SEQUENCE]
    pairs |= {(min(i, int(j)), max(i, int(j))) for i in range(count) for j in alike[i] if not near[i, j]}
    return sorted(pairs)


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

"""Whether images follow each other in steps that `klt` can follow, judged by a few small pairs of neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ImageOps

from modp_ti.files import open_file
from modp_ti.files.errors import InputError
from modp_ti.inputs.multiview.features import flow_there_and_back
from modp_ti.inputs.sources.image_header import HEADER_ERRORS, open_image

PAIRS, FEWEST_PAIRS = 12, 3
SIDE = 320  # longer side of the compared pictures [px]
CORNERS, FEWEST_CORNERS = 200, 20
LEVELS = 4
RETURNED = 1.0  # px
# Share of the corners that optical flow finds again in the next image. The median over the pairs is 0.17 for
# photographs along a street, of which klt places none and sfm 24 of 29, and 0.25 for courthouse, of which klt places
# 239 and sfm 285 of 286. From 0.36 on, klt places about as many as sfm, or none at all.
FOLLOWED = 0.3


def why_photographs(files: Sequence[Path]) -> str | None:
    """Return why images, in their order, are photographs rather than a sequence; None for a sequence.

    Those that cannot be read do not count, and a few images are a sequence. It takes about a second, however many there
    are.
    """
    shares, sizes = [], set()
    for i in np.unique(np.linspace(0, max(0, len(files) - 2), PAIRS).round().astype(int)).tolist():
        pair = [small for file in files[i : i + 2] if (small := _small(file)) is not None]
        sizes.update(size for _, size in pair)
        if len(pair) == 2 and (share := followed_share(pair[0][0], pair[1][0])) is not None:
            shares.append(share)
    if len(sizes) > 1:
        return "the images have several sizes"
    if len(shares) < FEWEST_PAIRS or np.median(shares) >= FOLLOWED:
        return None
    return f"only {np.median(shares):.0%} of an image's corners can be followed to the next"


def _small(path: Path) -> tuple[NDArray[np.uint8], tuple[int, ...]] | None:
    """An image in grey, upright and small, and its upright size (width, height); None if it cannot be read."""
    with suppress(*HEADER_ERRORS, InputError), open_file(path) as file:
        image = open_image(file)
        size = image.size
        image.draft("L", (SIDE, SIDE))  # JPEG files are decoded at a fraction of their size
        grey = ImageOps.exif_transpose(image.convert("L"))
        grey.thumbnail((SIDE, SIDE))
        return np.asarray(grey), tuple(sorted(size, reverse=grey.width > grey.height))
    return None


def followed_share(one: NDArray[np.uint8], after: NDArray[np.uint8]) -> float | None:
    """Share of the corners of a picture (H, W) that optical flow finds in that after it; None if it has few corners."""
    corners = cv2.goodFeaturesToTrack(one, CORNERS, 0.01, SIDE / 40)
    if one.shape != after.shape or corners is None or len(corners) < FEWEST_CORNERS:
        return None
    corners = np.asarray(corners, np.float32)
    there, off = flow_there_and_back(one, after, corners, corners, LEVELS, LEVELS)
    inside = ((there >= 0) & (there < one.shape[::-1])).all(axis=(1, 2))
    return float(np.mean((off < RETURNED) & inside))

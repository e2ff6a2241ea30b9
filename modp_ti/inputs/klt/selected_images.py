"""The selected images of a source, of one size, as the tracker takes them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources import FrameReader, ImageSource

FOLLOWED_SIDE = 640  # longer side [px] of the images in which features are tracked, at most


def available(reader: FrameReader) -> Sequence[str]:
    """Names of the selected images that are available so far."""
    source = reader.source
    return reader.images.names[source.start : source.stop : source.step]


def arriving(reader: FrameReader) -> Iterator[str]:
    """Names of all selected images, from the first one on, as they arrive."""
    source = reader.source
    return reader.images.arriving(source.start, source.stop, source.step)


def followed_scale(width: int, height: int) -> float:
    """Factor from the stored size to that of the images in which features are tracked."""
    return min(1.0, FOLLOWED_SIDE / max(width, height))


def read_image(images: ImageSource, name: str, width: int, height: int) -> NDArray[np.uint8]:
    """Decode an image (H, W, 3). Raises InputError if it has another size than this."""
    raw = images.read(name)
    require_size(images, name, (raw.shape[1], raw.shape[0]), (width, height))
    return raw


def require_size(images: ImageSource, name: str, size: tuple[int, int], first: tuple[int, int]) -> None:
    """Raise InputError if an image is not of the first one's size (width, height)."""
    if size != first:
        raise InputError(
            f"{images.path / name} is {size[0]}x{size[1]}, the first image {first[0]}x{first[1]}: klt follows images "
            "of one size; take the others out, or set tracker.kind=sfm"
        )

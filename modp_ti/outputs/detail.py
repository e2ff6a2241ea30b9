"""`explained_detail`: the share of an image's finest band that a render explains."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["explained_detail"]

SIGMA = 1.0  # blur that the finest band lies above [px]


def explained_detail(
    render: NDArray[np.floating], image: NDArray[np.floating], valid: NDArray[np.bool_]
) -> float | None:
    """Return 1 - |finest band of image - render|^2 / |finest band of image|^2.

    The finest band is an image minus itself blurred with a sigma of one pixel. PSNR hardly depends on it: a render that
    is as sharp as the image scores 1, a render blurred by much more than a pixel 0, and noise or misplaced edges less.

    Args:
        render: Rendered colour (H, W, 3) in [0, 1].
        image: Observed colour (H, W, 3) in [0, 1].
        valid: Pixels that count (H, W). The others neither count nor enter the blur.

    Returns:
        The share, None if the image has no detail.
    """
    weight = valid.astype(np.float32)[..., None]
    around = np.maximum(_blurred(weight), 1e-6)

    def finest(picture: NDArray[np.floating]) -> NDArray[np.float32]:
        counted = (np.asarray(picture, dtype=np.float32) * weight).astype(np.float32)
        return np.asarray(counted - weight * _blurred(counted) / around, dtype=np.float32)

    detail = finest(image)
    whole = float(np.square(detail, dtype=np.float64).sum())
    return None if whole == 0.0 else 1.0 - float(np.square(detail - finest(render), dtype=np.float64).sum()) / whole


def _blurred(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    blurred = np.asarray(cv2.GaussianBlur(picture, (0, 0), SIGMA, borderType=cv2.BORDER_REFLECT_101), dtype=np.float32)
    return blurred.reshape(picture.shape)

"""The boundary to the estimators of OpenCV and pycolmap, which raise on some input instead of finding nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

__all__ = ["estimated"]

P = ParamSpec("P")
R = TypeVar("R")


def estimated(estimator: Callable[P, R], *args: P.args, **options: P.kwargs) -> R | None:
    """Return what an estimator finds, None where it fails on these correspondences."""
    import cv2

    try:
        return estimator(*args, **options)
    except (cv2.error, ValueError, RuntimeError, IndexError):  # the latter three from C++, through pycolmap
        return None

"""Saving and restoring keyframes as plain arrays. Images are not saved; they are taken from the frames again."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore

# Scalars and small matrices of a `Keyframe`, with their shapes.
NUMBERS: dict[str, tuple[int, ...]] = {
    "index": (),
    "T_camera_world": (4, 4),
    "median_depth": (),
    "error": (),
}
POINTS = {"xyz": 3, "pixels": 2}
NO_MASK = np.zeros((0, 0), dtype=np.uint8)


def keyframe_arrays(store: Iterable[Keyframe]) -> dict[str, NDArray]:
    """Store keyframes as arrays.

    Args:
        store: The keyframes.

    Returns:
        One array per field of `NUMBERS`, `exposure` and `is_between`, with one row per keyframe. The rows of `exposure`
        are NaN for keyframes without one. `points` holds the number of tracked points of each keyframe; `xyz` (P, 3),
        `pixels` (P, 2) and `ids` (P,) hold the points of all keyframes, concatenated. If anything moves, `transient`
        holds the masks of all keyframes, concatenated, and `transient_size` (N, 2) their sizes, 0 without a mask.
    """
    views = list(store)
    arrays: dict[str, NDArray] = {
        name: np.array(
            [getattr(view, name) for view in views], dtype=np.int64 if name == "index" else np.float64
        ).reshape(-1, *shape)
        for name, shape in NUMBERS.items()
    }
    unknown = np.full((3, 4), np.nan)
    exposures = [unknown if view.exposure is None else view.exposure for view in views]
    arrays["exposure"] = np.array(exposures).reshape(-1, 3, 4)
    arrays["is_between"] = np.array([view.is_between for view in views], dtype=np.int64)
    arrays["points"] = np.array([len(view.points) for view in views], dtype=np.int64)
    for name, width in POINTS.items():
        parts = [getattr(view.points, name) for view in views]
        arrays[name] = np.concatenate([*parts, np.zeros((0, width))])
    arrays["ids"] = np.concatenate([*(view.points.ids for view in views), np.zeros(0, dtype=np.int64)])
    masks = [NO_MASK if view.transient is None else view.transient for view in views]
    if any(mask.size for mask in masks):
        arrays["transient"] = np.concatenate([mask.ravel() for mask in masks])
        arrays["transient_size"] = np.array([mask.shape for mask in masks], dtype=np.int64)
    return arrays


class KeyframeRows:
    """Restores the keyframes of `keyframe_arrays` into a store, frame by frame.

    Attributes:
        rows: Row of each keyframe, by frame index.
    """

    def __init__(self, arrays: Mapping[str, NDArray]) -> None:
        self.rows = {int(index): row for row, index in enumerate(arrays["index"])}
        self._arrays = arrays
        self._first = np.append(0, np.cumsum(arrays["points"]))
        self._mask_size = arrays.get("transient_size", np.zeros((len(self.rows), 2), dtype=np.int64))
        self._masks = np.split(arrays.get("transient", NO_MASK.ravel()), np.cumsum(self._mask_size.prod(axis=1))[:-1])

    def put(self, frame: TrackedFrame, store: KeyframeStore) -> None:
        """Restore the next keyframe from its frame.

        Args:
            frame: Frame of the next row.
            store: Store that the keyframe is appended to.

        Raises:
            ValueError: If `frame` is not the frame of the next row.
        """
        row = len(store)
        if self.rows.get(frame.index) != row:
            raise ValueError(f"frame {frame.index} is not keyframe {row}")
        view = store.append(frame, bool(self._arrays["is_between"][row]))
        view.T_camera_world = np.array(self._arrays["T_camera_world"][row])
        view.median_depth, view.error = (float(self._arrays[name][row]) for name in ("median_depth", "error"))
        exposure = self._arrays["exposure"][row]
        view.exposure = None if np.isnan(exposure).all() else np.array(exposure)
        own = slice(self._first[row], self._first[row + 1])
        view.points = SparsePoints(*(np.array(self._arrays[name][own]) for name in ("xyz", "pixels", "ids")))
        if self._masks[row].size:
            store.mask(view, self._masks[row].reshape(self._mask_size[row]))

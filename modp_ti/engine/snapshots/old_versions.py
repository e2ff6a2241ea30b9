"""Conversion of snapshots that earlier versions of the program wrote."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

__all__ = ["convert_version_2", "convert_version_3"]


def convert_version_2(arrays: dict[str, NDArray], numbers: dict[str, Any]) -> None:
    """Convert arrays and numbers of version 2 in place.

    It saved the tracked poses of all frames beside those of the mapped ones, and the gate's two once more.

    Raises:
        IndexError, KeyError, TypeError: If the snapshot is incomplete.
    """
    arrays["tracked.T"] = arrays.pop("frames.T_tracked")
    arrays["tracked.index"], arrays["tracked.held_out"] = arrays["frames.index"], arrays["frames.held_out"]
    gate = numbers["map"]["gate"]
    gate["before"] = [None if pair is None else pair[0] for pair in gate["before"]]


def convert_version_3(arrays: dict[str, NDArray], numbers: dict[str, Any]) -> None:
    """Convert arrays and numbers of version 3 in place.

    Its marks of voxels have another layout, so that those of the Gaussians are made again.

    Raises:
        KeyError, TypeError: If the snapshot is incomplete.
    """
    for name in ("voxels.places", "voxels.words"):
        arrays.pop(name, None)
    numbers["map"]["voxels_made_again"] = True

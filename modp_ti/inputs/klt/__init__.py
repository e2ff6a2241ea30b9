"""Tracker `klt`: poses and points from the images alone, while they arrive."""

from modp_ti.inputs.klt.tracker import KltTracker, open_klt

__all__ = ["KltTracker", "open_klt"]

"""Tracker `klt`: online poses and sparse points from the images alone."""

from modp_ti.inputs.klt.tracker import KltTracker, open_klt

__all__ = ["KltTracker", "open_klt"]

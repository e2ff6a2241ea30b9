"""Tracker `klt`: online poses and sparse points from the images alone."""

from modp_ti.inputs.klt.opening import open_klt
from modp_ti.inputs.klt.tracker import KltTracker

__all__ = ["KltTracker", "open_klt"]

"""Tracking in a process of its own, beside the mapper: `parent.py` in the mapper's process, `child.py` in the other."""

from modp_ti.inputs.tracking_process.parent import TrackingProcess

__all__ = ["TrackingProcess"]

"""Readers of poses and sparse points, one file per kind. Each delivers `TrackedFrame`s in order.

The registry of kinds is in `openers`; their settings are in `modp_ti.config.tracker_settings`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from modp_ti.inputs.protocol import Progress, Tracker
from modp_ti.inputs.trackers.openers import OPENERS, Opening

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig

__all__ = ["Progress", "Tracker", "open_tracker"]


def open_tracker(config: SceneConfig, progress: Progress | None = None) -> Tracker:
    """Open the configured tracker. Its input is checked as far as possible without decoding all images.

    Args:
        config: The scene configuration. Only `source`, `tracker` and `seed` are used.
        progress: Called while the tracker prepares, for example while it triangulates points.

    Raises:
        InputError: If the input is invalid.

    Example:
        for frame in modp_ti.open_tracker(modp_ti.load_scene("scene.yaml")):
            print(frame.name, len(frame.points))
    """
    return OPENERS[type(config.tracker)](config.tracker, Opening(config.source, config.seed, progress))

"""Where poses and sparse points come from: one file per kind, each giving `TrackedFrame`s in order.

`openers` has the kinds; their settings are in `modp_ti.config.tracker_settings`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from modp_ti.inputs.protocol import Progress, Tracker
from modp_ti.inputs.trackers.openers import OPENERS, Opening

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig

__all__ = ["Progress", "Tracker", "open_tracker"]


def open_tracker(config: SceneConfig, progress: Progress | None = None) -> Tracker:
    """The tracker that the configuration asks for, its input checked as far as possible without decoding.

    Args:
        config: The scene; its source, its tracker and its seed count.
        progress: Called while a tracker prepares (triangulates).

    Raises:
        InputError: For bad input.
    """
    return OPENERS[type(config.tracker)](config.tracker, Opening(config.source, config.seed, progress))

"""The embedded demo sequence: a furnished room that the project renders itself, with a simulated tracker."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from modp_ti.files.errors import InputError
from modp_ti.inputs.synthetic.light import LightChange
from modp_ti.inputs.synthetic.loop import Loop
from modp_ti.inputs.synthetic.simulated_tracker import FRAMES, LOOP_FRAMES, SMALLEST, SyntheticTracker, TrackerNoise

if TYPE_CHECKING:
    from modp_ti.config.settings import SourceSettings
    from modp_ti.config.tracker_settings import SyntheticSettings
    from modp_ti.inputs.synthetic.renderer import RoomRenderer

__all__ = ["LightChange", "Loop", "SyntheticTracker", "TrackerNoise", "open_synthetic"]

WIDTH, HEIGHT = 320, 240  # [px] at scale 1


def open_synthetic(
    source: SourceSettings, tracker: SyntheticSettings, room: RoomRenderer | None = None
) -> SyntheticTracker:
    """The demo sequence; with drift or correction the camera walks in a loop.

    Of `source`, scale, start, stop, step, holdout and fps count; of `tracker` exposure_change, drift and correction.
    room: one that is built already. Raises InputError where the scale leaves no picture or the range no frames, and for
    masks or a vignette.
    """
    if source.masks is not None or source.mask_colour is not None or source.vignette is not None:
        raise InputError("the demo room has neither masks nor a vignette: take source.masks, mask_colour, vignette out")
    width, height = round(WIDTH * source.scale), round(HEIGHT * source.scale)
    if min(width, height) < SMALLEST:
        least = math.ceil(100 * SMALLEST / HEIGHT) / 100
        raise InputError(
            f"source.scale {source.scale:g} leaves {width}x{height} pixels of the demo: use {least} or more"
        )
    select = slice(source.start, source.stop, source.step)
    loop = Loop(tracker.drift, tracker.correction) if tracker.drift or tracker.correction else None
    frames = FRAMES if loop is None else LOOP_FRAMES
    if not range(frames)[select]:
        raise InputError(f"source.start {source.start} lies behind the {frames} frames of the demo room")
    return SyntheticTracker(
        width=width,
        height=height,
        frames=frames,
        select=select,
        holdout=source.holdout or 0,
        fps=source.fps,
        light=LightChange().scaled(tracker.exposure_change),
        loop=loop,
        room=room,
    )

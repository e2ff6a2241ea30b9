"""Another tracker for a recording of which the first one placed few images."""

from __future__ import annotations

from contextlib import closing

from modp_ti.config.settings import SceneConfig
from modp_ti.engine.stages import OpenRun
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_tracker

# Share of the images from which on the first tracker is good enough.
ENOUGH = 0.8


def better_tracker(config: SceneConfig, run: OpenRun, placed: int) -> SceneConfig | None:
    """Try the second choice of the tracker's settings where few images were placed, and say so.

    Args:
        config: The settings of the run.
        run: The run, whose tracker has delivered all frames.
        placed: Number of them.

    Returns:
        The settings with the other tracker if it places more images, otherwise None. Its model is kept for the run.
    """
    images = placed + run.tracker.unplaced
    second = config.tracker.second_choice(images)
    if second is None or placed >= ENOUGH * images or config.is_realtime or config.onto is not None:
        return None
    first, other = config.tracker.kind, config.model_copy(update={"tracker": second})
    run.say(f"{first} could place only {placed} of {images} images: {second.kind} is tried on them")
    try:
        with run.stop.waiting(), closing(open_tracker(other, run.line.prepare)) as tracker:
            found = len(tracker.frames)
    except InputError as error:
        run.say(str(error))
        return None
    if found <= placed:
        run.say(f"{second.kind} places {found} images, and so the map is of {first}'s {placed}")
        return None
    run.say(f"{second.kind} places {found} of {images} images: they are mapped with it instead")
    return other

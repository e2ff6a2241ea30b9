"""`Companion`: what goes with the paper's loop and is no part of it, such as paging, places and masks of what moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.render.renderer import Renderer


class Companion:
    """A part of the mapper that the loop calls at fixed places. All methods do nothing here.

    A mapper has a list of companions, which are called in its order. One that draws random numbers draws them from the
    mapper's generator, so that the order is part of the result.
    """

    def before_frame(self, frame: TrackedFrame, is_wanted: bool) -> None:
        """Called with each frame before it is added to the map, as a keyframe if that is wanted and has room."""

    def after_view(self, place: int) -> None:
        """Called when a frame has become a view of the map, at this place in the store."""

    def new_keyframe(self, store: KeyframeStore, renderer: Renderer, near: float) -> None:
        """Called with each new keyframe, the last of the store, after its pose is aligned and before it adds Gaussians.

        The renderer's images may be overwritten.
        """

    def before_step(self) -> None:
        """Called before each optimisation step."""

    def before_views(self, views: Sequence[Keyframe]) -> None:
        """Called with the views of each Adam step before they are rendered."""

    def before_update(self, views: Sequence[Keyframe]) -> None:
        """Called with these views when all gradients are known, before the Gaussians are updated."""

    def after_keyframe(self, near: float, swept: int | None) -> None:
        """Called after the steps of a new keyframe. For `swept`, see `Plan`."""

    def before_passes(self, places: NDArray[np.int64], near: float) -> None:
        """Called before the passes over the keyframes at these places (N,) that finish or refine a map."""

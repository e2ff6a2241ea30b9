"""`TransientSweep`: masks what moves in the keyframes of a map, and removes the Gaussians that it has left."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import GaussianField
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.blocks.paging import Paging
from pipelines.companions import Companion
from pipelines.render.renderer import Renderer
from pipelines.transients.evidence import CoarseView, coarse_view, moving, soft_mask, votes

__all__ = ["EVERY", "YOUNG", "TransientSweep", "compared", "latest", "neighbours", "place_of", "without"]

# While frames arrive, the last WINDOW keyframes are compared after every EVERY keyframes. The last YOUNG of them have
# been optimised too little, and are only asked about the others.
WINDOW, EVERY, YOUNG = 48, 8, 4
# Distances of the neighbours in the order of the keyframes: near ones see the same surfaces, far ones another moment.
# FAR others are spread over all keyframes, for cameras that come back.
DISTANCES, FAR = (2, 3, 5, 7, 10, 13, 17, 21, 26, 31), 16
# Rounds of a sweep. Cells that one round masks do not vote in the next.
ROUNDS = 2


def compared(
    renderer: Renderer,
    view: Keyframe,
    T_camera_world: NDArray[np.float64],
    exposure: NDArray[np.float64] | None,
    near: float,
) -> CoarseView:
    """Render a keyframe and compare it with its image, without its mask of what moves.

    Args:
        renderer: Renderer of the map. Its images are overwritten.
        view: The keyframe, which is compared at half its size if its pyramid has that.
        T_camera_world: Pose (4, 4) to render from.
        exposure: Exposure (3, 4); None for the identity.
        near: Depth below which nothing is drawn [scene units].
    """
    image = view.whole_image(1)
    renderer.forward(image.camera, T_camera_world, near)
    renderer.develop(exposure, view.vignette)
    return coarse_view(renderer.rendered(), image.rgba, image.camera, T_camera_world)


def latest(keyframes: KeyframeStore) -> list[Keyframe]:
    """Return the latest keyframes if enough have come since the last sweep, none otherwise."""
    return list(keyframes)[-WINDOW:] if len(keyframes.selected) % EVERY == 0 else []


def neighbours(place: int, count: int) -> list[int]:
    """Return the places of the neighbours of a view among `count` keyframes; `place` may lie between two of them."""
    both = {place + sign * distance for distance in DISTANCES for sign in (-1, 1)}
    both |= {other * count // FAR for other in range(FAR) if abs(other * count // FAR - place) > 1}
    return sorted(other for other in both if 0 <= other < count)


class TransientSweep(Companion):
    """Masks what moves in keyframes, and removes its Gaussians.

    Args:
        gaussians: The Gaussians of the map.
        keyframes: The keyframes of the map.
        renderer: Renderer of the map.
        paging: Keeps the part of the map that is on disk.
    """

    def __init__(self, gaussians: GaussianField, keyframes: KeyframeStore, renderer: Renderer, paging: Paging) -> None:
        self.gaussians = gaussians
        self.keyframes = keyframes
        self.renderer = renderer
        self.paging = paging

    def after_keyframe(self, near: float, swept: int | None) -> None:
        self.sweep(latest(self.keyframes), near, YOUNG)

    def before_passes(self, places: NDArray[np.int64], near: float) -> None:
        self.sweep([self.keyframes[place] for place in places.tolist()], near)

    def sweep(self, views: Sequence[Keyframe], near: float, young: int = 0) -> None:
        """Mask what moves in keyframes, and remove the Gaussians that most of them contradict.

        Args:
            views: Consecutive keyframes.
            near: Depth below which nothing is drawn [scene units].
            young: Number of the last ones whose masks stay as they are.
        """
        if not views or len(self.gaussians) == 0:
            return
        coarse = []
        for view in views:
            self.paging.before_views([view])
            coarse.append(compared(self.renderer, view, view.T_camera_world, view.exposure, near))
        masks = [view.transient for view in views]
        for _ in range(ROUNDS):
            voters = [without(c, mask) for c, mask in zip(coarse, masks, strict=True)]
            for place, view in enumerate(views[: len(views) - young]):
                others = [voters[other] for other in neighbours(place, len(views))]
                masks[place] = soft_mask(*moving(coarse[place], others, kept=True), before=view.transient)
            if not any(mask is not None for mask in masks):
                break
        for view, mask in zip(views, masks, strict=True):
            if mask is not None or view.transient is not None:
                self.keyframes.mask(view, mask)
        self._remove(views, coarse)

    def _remove(self, views: Sequence[Keyframe], coarse: Sequence[CoarseView]) -> None:
        """Remove Gaussians that masks cover in some views, and that are wrong in most of the others that see them."""
        masked = [
            replace(c, valid=c.valid & (view.transient == 0))
            for c, view in zip(coarse, views, strict=True)
            if view.transient is not None
        ]
        if not masked:
            return
        position = self.gaussians.to_numpy()["position"].astype(np.float64)
        suspect = np.flatnonzero(votes(position, masked).looks > 0)
        free = [without(c, v.transient) for c, v in zip(coarse, views, strict=True)]
        ballot = votes(position[suspect], free)
        inside = votes(position[suspect], masked).looks
        keep = np.ones(len(position), dtype=bool)
        keep[suspect] = 2 * (ballot.wrong + inside) < ballot.looks + inside
        self.gaussians.remove(keep)


def without(view: CoarseView, mask: NDArray[np.uint8] | None) -> CoarseView:
    """Return the view without its masked cells, which do not vote."""
    return view if mask is None else replace(view, valid=view.valid & (mask > 0))


def place_of(views: Sequence[Keyframe], index: int) -> int:
    """Return the place that frame `index` has, or would have, among keyframes."""
    return bisect_left(views, index, key=lambda view: view.index)

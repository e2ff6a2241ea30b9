"""`TransientSweep`: masks what moves in the keyframes of a map, and removes the Gaussians that it has left.

A view shows something that moves where it differs from the map's render although the surface that the map has there is
rendered rightly in most other views that see it. Where the other views are wrong too, the map is wrong: it is not
optimised enough, or has kept a ghost of what moved. A ghost is recognised by the reverse: the view is right, and most
others are wrong.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from fields.map.gaussians import GaussianField
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.companions.companion import Companion
from pipelines.companions.paging import Paging
from pipelines.render.renderer import RenderedView, Renderer

# Width of the grid on which views are compared [cells].
CELLS = 80
# Standard deviation of the window in which differences are averaged [image widths]. Texture that is slightly out of
# place averages to zero; something else does not.
BLUR = 0.01
# Relative difference of depths below which two views show the same surface.
SAME_DEPTH = 0.08
# Opacity from which a render has a depth.
MIN_OPACITY = 0.7
# Difference from which a view is wrong [1 = white], and as a factor on its median difference. RIGHT of it is right.
WRONG, FACTOR, RIGHT = 0.1, 6.0, 0.3
# Number of other views that must see a surface, and the share of them that must agree.
MIN_LOOKS, MAJORITY = 3, 0.65


@dataclass(frozen=True, slots=True)
class CoarseView:
    """A view compared with the map, on a coarse grid.

    Attributes:
        camera: Camera of the grid.
        T_camera_world: Pose (4, 4).
        difference: Magnitude (h, w) of the difference between render and image, averaged in a window [1 = white]; 0
            where the image has no valid pixels.
        depth: Rendered depth (h, w); 0 where it is unknown [scene units].
        valid: Whether the image is valid (h, w).
        wrong: Difference from which the view is wrong [1 = white].
    """

    camera: PinholeCamera
    T_camera_world: NDArray[np.float64]
    difference: NDArray[np.float32]
    depth: NDArray[np.float32]
    valid: NDArray[np.bool_]
    wrong: float

    def surface(self, cells: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the points (N, 3) of the surface in the world frame at some cells (h, w), which must have a depth."""
        row, column = np.nonzero(cells)
        there = self.camera.unproject(np.stack([column + 0.5, row + 0.5], axis=1), self.depth[row, column])
        T_world_camera = inverse_se3(self.T_camera_world)
        return there @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def coarse_view(
    render: RenderedView,
    rgba: NDArray[np.uint8],
    camera: PinholeCamera,
    T_camera_world: NDArray[np.float64],
) -> CoarseView:
    """Compare a render with its image.

    Args:
        render: The render, with its colour developed.
        rgba: Image (H, W, 4) with its mask in the last channel.
        camera: Camera of the image.
        T_camera_world: Pose (4, 4).
    """
    width = min(CELLS, camera.width)
    size = (width, max(round(camera.height * width / camera.width), 1))
    valid = rgba[..., 3] > 0
    difference = np.clip(render.colour, 0.0, 1.0).astype(np.float32) - rgba[..., :3] / np.float32(255.0)
    difference[~valid] = 0.0
    mean = cv2.GaussianBlur(difference, (0, 0), max(BLUR * camera.width, 0.5))
    magnitude = np.asarray(cv2.resize(np.abs(mean).mean(axis=2), size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    depth = render.expected_depth(MIN_OPACITY).astype(np.float32)
    known = np.asarray(cv2.resize(valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST), dtype=bool)
    usual = float(np.median(magnitude[known])) if known.any() else 0.0
    return CoarseView(
        camera=camera.resized(*size),
        T_camera_world=T_camera_world,
        difference=magnitude,
        depth=np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST), dtype=np.float32),
        valid=known,
        wrong=max(WRONG, FACTOR * usual),
    )


@dataclass(frozen=True, slots=True)
class Ballot:
    """Votes of views about surface points.

    Attributes:
        looks: Number (N,) of views that see the point.
        right: Number (N,) of them in which its render is right.
        wrong: Number (N,) of them in which it is wrong.
    """

    looks: NDArray[np.int64]
    right: NDArray[np.int64]
    wrong: NDArray[np.int64]

    @property
    def mostly_right(self) -> NDArray[np.bool_]:
        """Whether enough views see the point (N,) and most are right."""
        return (self.looks >= MIN_LOOKS) & (self.right >= MAJORITY * self.looks)

    @property
    def mostly_wrong(self) -> NDArray[np.bool_]:
        """Whether enough views see the point (N,) and most are wrong."""
        return (self.looks >= MIN_LOOKS) & (self.wrong >= MAJORITY * self.looks)


def votes(xyz: NDArray[np.float64], views: Sequence[CoarseView]) -> Ballot:
    """Ask views whether surface points (N, 3) are rendered rightly in them."""
    looks, right, wrong = np.zeros((3, len(xyz)), dtype=np.int64)
    for view in views:
        there = xyz @ view.T_camera_world[:3, :3].T + view.T_camera_world[:3, 3]
        seen = np.flatnonzero(there[:, 2] > 0)
        pixels = view.camera.project(there[seen])
        inside = view.camera.contains(pixels)
        seen = seen[inside]
        column, row = pixels[inside].astype(np.int64).T
        z = there[seen, 2]
        same = view.valid[row, column] & (np.abs(view.depth[row, column] - z) < SAME_DEPTH * z)
        seen, difference = seen[same], view.difference[row[same], column[same]]
        looks[seen] += 1
        right[seen] += difference < RIGHT * view.wrong
        wrong[seen] += difference >= view.wrong
    return Ballot(looks, right, wrong)


def moving(view: CoarseView, others: Sequence[CoarseView], kept: bool) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Decide where a view shows something that moves.

    Args:
        view: The view.
        others: Other views of the same surfaces, from other times.
        kept: Whether the map was optimised on the view, so that it may contain ghosts of what moved there.

    Returns:
        Two masks (h, w): where it is certain, and where it is likely. The second contains the first.
    """
    certain = np.zeros(view.depth.shape, dtype=bool)
    likely = certain.copy()
    cells = view.valid & (view.depth > 0)
    ballot = votes(view.surface(cells), others)
    difference = view.difference[cells]
    certain[cells] = (difference >= view.wrong) & ballot.mostly_right
    likely[cells] = (difference >= 0.5 * view.wrong) & ballot.mostly_right
    if kept:
        ghost = np.zeros_like(certain)
        ghost[cells] = (difference < view.wrong) & ballot.mostly_wrong
        certain |= ghost
    return certain, likely | certain


# Smallest thing that is masked, and largest share of the image that all of them may take [of the image's cells]. More
# than that is a wrong pose or a map that is not good enough yet.
MIN_SHARE, MAX_SHARE = 0.005, 0.6
# Diameter of the neighbourhood in which most cells must agree, and of the margin around a mask [cells].
NEIGHBOURHOOD, MARGIN = 5, 5
# Standard deviation of the soft edge [cells].
EDGE = 1.0


def soft_mask(
    certain: NDArray[np.bool_], likely: NDArray[np.bool_], before: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8] | None:
    """Make a smooth mask with hysteresis from cell-wise decisions.

    A connected region of likely cells is masked if it contains certain cells, or cells that were masked before.

    Args:
        certain: Cells (h, w) that certainly show something that moves.
        likely: Cells (h, w) that probably do; contains `certain`.
        before: The earlier mask, as returned; None for none.

    Returns:
        Weights (h, w) uint8, 0 on what moves and 255 elsewhere, with a soft edge outside; None if nothing moves.
    """
    agreed = _most(likely)
    start = _most(certain)
    if before is not None:
        start |= before == 0
    label = np.asarray(cv2.connectedComponents(agreed.astype(np.uint8), connectivity=8)[1], dtype=np.int64)
    area = np.bincount(label.ravel())
    started = np.bincount(label.ravel(), weights=start.ravel()) > 0
    chosen = started & (area >= MIN_SHARE * label.size)
    chosen[0] = False
    masked = chosen[label]
    if not masked.any():
        return None
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (MARGIN, MARGIN))
    core = cv2.dilate(cv2.morphologyEx(masked.astype(np.uint8), cv2.MORPH_CLOSE, kernel), kernel)
    if core.mean() > MAX_SHARE:
        return None
    soft = cv2.GaussianBlur(core.astype(np.float32), (0, 0), EDGE)
    return np.where(core > 0, 0, np.rint(255 * np.clip(1.0 - 2.0 * soft, 0.0, 1.0))).astype(np.uint8)


def _most(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether more than half of the neighbourhood of each cell (h, w) is set."""
    share = cv2.blur(cells.astype(np.float32), (NEIGHBOURHOOD, NEIGHBOURHOOD), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(share) > 0.5


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
    """Masks what moves in keyframes, and removes its Gaussians."""

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

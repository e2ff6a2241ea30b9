"""`ChangeSweep`: masks in the keyframes of an earlier visit what has changed since, and removes its Gaussians."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import GaussianField
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.companions.companion import Companion
from pipelines.companions.paging import Paging
from pipelines.companions.transients import EVERY, SAME_DEPTH, YOUNG, CoarseView, compared, latest, soft_mask, votes
from pipelines.render.renderer import Renderer


@dataclass(frozen=True)
class EarlierVisit:
    """The map that a recording goes on with.

    Attributes:
        gaussians: Its Gaussians, as from `GaussianField.to_numpy`.
        frames: Number of its frames, which have the indices below.
    """

    gaussians: Mapping[str, NDArray]
    frames: int


class ChangeSweep(Companion):
    """Masks what has changed since an earlier visit in its keyframes, and removes the Gaussians of what is gone.

    Keyframes of both visits ask for the place as they saw it, so that the map would become a mixture. Where they
    contradict each other, the later ones are right. What the earlier ones saw is read from the map that they made,
    which is kept unchanged: the map that is optimised on both is between them.
    """

    def __init__(
        self,
        earlier: EarlierVisit,
        gaussians: GaussianField,
        keyframes: KeyframeStore,
        renderer: Renderer,
        paging: Paging,
    ) -> None:
        self.earlier = earlier
        self.gaussians = gaussians
        self.keyframes = keyframes
        self.renderer = renderer
        self.paging = paging

    def after_keyframe(self, near: float, swept: int | None) -> None:
        self.sweep(latest(self.keyframes)[-2 * EVERY : -YOUNG], near)

    def before_passes(self, places: NDArray[np.int64], near: float) -> None:
        self.sweep([self.keyframes[place] for place in places.tolist()], near)

    def sweep(self, views: Sequence[Keyframe], near: float) -> None:
        """Mask in the keyframes of the earlier visit what these views show to have changed.

        Args:
            views: Keyframes, of which those of the later visit count.
            near: Depth below which nothing is drawn [scene units].
        """
        later = [view for view in views if view.index >= self.earlier.frames]
        if not later or len(self.gaussians) == 0:
            return
        now, then = self._compared(later, near)
        changes = Changes(now, then)
        xyz = changes.points()
        seeing = [view for view in self.keyframes if view.index < self.earlier.frames and _sees(view, xyz)]
        if not seeing:
            return
        masked = []
        for view, *versions in zip(seeing, *self._compared(seeing, near), strict=True):
            certain = changes.seen_by(*versions)
            mask = soft_mask(certain, certain)
            if mask is not None:
                self.keyframes.mask(view, mask if view.transient is None else np.minimum(mask, view.transient))
            if view.transient is not None:
                masked.append(replace(versions[0], valid=versions[0].valid & (view.transient == 0)))
        position = self.gaussians.to_numpy()["position"].astype(np.float64)
        gone = (votes(position, masked).looks > 0) & votes(position, now).mostly_wrong
        self.gaussians.remove(~gone)

    def _compared(self, views: Sequence[Keyframe], near: float) -> tuple[list[CoarseView], list[CoarseView]]:
        """Compare the images of views with the present map, and with that of the earlier visit."""

        def compare(view: Keyframe) -> CoarseView:
            return compared(self.renderer, view, view.T_camera_world, view.exposure, near)

        now = []
        for view in views:
            self.paging.before_views([view])
            now.append(compare(view))
        with self._earlier_map():
            return now, [compare(view) for view in views]

    @contextmanager
    def _earlier_map(self) -> Iterator[None]:
        """Have the Gaussians of the earlier visit in the place of those of the map."""
        gaussians = self.gaussians
        state = gaussians.to_numpy() | gaussians.history() | {"coverage": gaussians.coverages()}
        gaussians.load(dict(self.earlier.gaussians))
        try:
            yield
        finally:
            gaussians.restore(state)


class Changes:
    """What views of a later visit tell about surfaces, compared with the present map and with that of then."""

    def __init__(self, now: Sequence[CoarseView], then: Sequence[CoarseView]) -> None:
        # A surface of the earlier map that is hidden by a new one may still be there.
        self._gone = [replace(b, valid=b.valid & ~_is_hidden(a, b)) for a, b in zip(now, then, strict=True)]
        # Where the earlier map shows nothing, nothing has changed.
        self._new = [replace(b, depth=a.depth, valid=b.valid & (b.depth > 0)) for a, b in zip(now, then, strict=True)]

    def points(self) -> NDArray[np.float64]:
        """Return the surface points (N, 3) that the earlier map shows wrongly in most views."""
        found = [np.zeros((0, 3))]
        for views in (self._gone, self._new):
            for view in views:
                xyz = view.surface(view.valid & (view.depth > 0) & (view.difference >= view.wrong))
                found.append(xyz[votes(xyz, views).mostly_wrong])
        return np.concatenate(found)

    def seen_by(self, now: CoarseView, then: CoarseView) -> NDArray[np.bool_]:
        """Return where (h, w) a view of the earlier visit, compared with the maps of both visits, shows a change."""
        found = np.zeros(then.depth.shape, dtype=bool)
        for view, voters in ((then, self._gone), (replace(then, depth=now.depth), self._new)):
            cells = then.valid & (view.depth > 0) & (then.difference < then.wrong)
            found[cells] |= votes(view.surface(cells), voters).mostly_wrong
        return found


def _is_hidden(now: CoarseView, then: CoarseView) -> NDArray[np.bool_]:
    """Whether the present map hides the surface (h, w) of the earlier one."""
    return (now.depth > 0) & (now.depth < (1.0 - SAME_DEPTH) * then.depth)


def _sees(view: Keyframe, xyz: NDArray[np.float64]) -> bool:
    """Whether any of the points (N, 3) lies in the image of a keyframe."""
    there = xyz @ view.T_camera_world[:3, :3].T + view.T_camera_world[:3, 3]
    ahead = there[there[:, 2] > 0]
    return bool(view.camera.contains(view.camera.project(ahead)).any())

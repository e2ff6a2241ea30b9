"""`HiddenGaussians`: removes Gaussians that hardly show in any keyframe, while the map grows."""
# pyright: reportArgumentType=false, reportInvalidTypeForm=false, reportOptionalSubscript=false

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from fields.map.gaussians import GaussianField
from fields.map.keyframe import Keyframe
from fields.runtime.engine import ti
from pipelines.companions.companion import Companion
from pipelines.companions.pace import FIRST_SWEEP
from pipelines.companions.paging import Paging
from pipelines.densify.densifier import Densifier
from pipelines.render.renderer import Renderer


@ti.data_oriented
class Contribution:
    """Measures how many pixels each Gaussian covers in the view that shows most of it, as `GaussianField.coverage`.

    The coverage in one view is the sum of the Gaussian's compositing weight alpha T over the valid pixels. It is
    computed by compositing's backward pass, as the derivative of the sum of all red values with respect to the
    Gaussian's red value.
    """

    def __init__(self, gaussians: GaussianField, renderer: Renderer) -> None:
        self.gaussians = gaussians
        self.renderer = renderer
        self.images, self.projected = renderer.images, renderer.projected

    def begin(self) -> None:
        """Set the coverage of all Gaussians to zero."""
        if self.gaussians.count:
            self._clear(self.gaussians.count)

    def measure(self, views: Iterable[Keyframe], near: float, level: int = 0) -> None:
        """Render further views, and raise each Gaussian's coverage to that in the view that shows most of it.

        Args:
            views: Views to render.
            near: Depth below which nothing is drawn [scene units].
            level: Pyramid level to render at. The coverage is that in pixels of the full size, nearly the same from
                each level.
        """
        renderer, images = self.renderer, self.images
        for view in views:
            image = view.image(level)
            renderer.forward(image.camera, view.T_camera_world, near)
            images.set_reference(image.rgba)
            self._ask_for_weights(3 * images.plane, images.plane)
            renderer.compositing.backward()
            self._keep_largest(view.camera.width * view.camera.height / (image.camera.width * image.camera.height))
            renderer.view_renders += 1

    @ti.kernel
    def _clear(self, count: ti.i32):
        for i in range(count):
            self.gaussians.coverage[i] = 0.0

    @ti.kernel
    def _ask_for_weights(self, places: ti.i32, plane: ti.i32):
        for i in range(places):
            weight = ti.cast(0.0, self.images.real)
            if i < plane:
                weight = self.images.valid[i]
            self.images.colour_grad[i] = weight

    @ti.kernel
    def _keep_largest(self, pixels: ti.f32):
        for s in range(self.projected.seen[None]):
            i = self.projected.gaussian[s]
            here = pixels * ti.cast(self.projected.colour.grad[s][0], ti.f32)
            self.gaussians.coverage[i] = ti.max(self.gaussians.coverage[i], here)
            self.gaussians.touched[i] = 0  # a GPU's compositing expects that projection adds gradients


# Number of keyframes before a sweep whose Gaussians may still grow, and are not removed.
YOUNG = 10
# Pyramid level of a sweep in parts, which is made while frames arrive. It takes half as long as at the full size.
COARSE = 1


class HiddenGaussians(Companion):
    """Sweeps over the keyframes, a few at a time or all at once, and then removes what hardly showed in any of them.

    A sweep spares the Gaussians that were placed in the `YOUNG` keyframes before it or while it went on. It leaves out
    keyframes that are far away or see much of what lies on disk, and spares what they placed, so that its time does not
    grow with a map that is larger than memory.

    Args:
        contribution: Measures how much of each Gaussian shows.
        densifier: Owner of the map's Gaussians and keyframes.
        paging: Keeps the part of the map that is on disk.
        min_contribution: Coverage in the keyframe that shows most of a Gaussian, below which it is removed [px].

    Attributes:
        due: Number of keyframes at which `sweep_when_due` sweeps next.
    """

    def __init__(
        self, contribution: Contribution, densifier: Densifier, paging: Paging, min_contribution: float
    ) -> None:
        self.contribution = contribution
        self._densifier = densifier
        self._paging = paging
        self._min_contribution = min_contribution
        self.due = FIRST_SWEEP
        self._swept = 0
        self._left_out: list[Keyframe] = []
        self._young: Keyframe

    def after_keyframe(self, near: float, swept: int | None) -> None:
        if swept is None:
            self.sweep_when_due(near)
        else:
            self.sweep(swept, near)

    def sweep_when_due(self, near: float) -> None:
        """Sweep over all keyframes that are near, if half as many have come since the last such sweep."""
        selected = self._densifier.keyframes.selected
        while self.due < len(selected):  # they came with a finished map
            self.due += -(-self.due // 2)
        if self.due > len(selected) or self._min_contribution == 0.0:
            return
        self._begin()
        views = self._near(selected)
        self.due += -(-max(len(views), FIRST_SWEEP) // 2)
        self._measure(views, near, 0)
        self._remove(self._min_contribution, self._densifier.first_anchor_since(selected[-YOUNG:][0]))

    def sweep(self, count: int, near: float) -> None:
        """Measure the next `count` keyframes. After the last one, Gaussians are removed, and the next sweep begins."""
        store = self._densifier.keyframes
        if count == 0 or not store.selected or self._min_contribution == 0.0:
            return
        if self._swept == 0:
            self._begin()
            self._young = store.selected[-YOUNG:][0]
        self._measure(self._near(store.selected[self._swept : self._swept + count]), near, COARSE)
        self._swept += count
        if self._swept >= len(store.selected):
            self._swept = 0
            self._remove(self._min_contribution, self._densifier.first_anchor_since(self._young))

    def remove(self, min_contribution: float, near: float) -> None:
        """Remove all Gaussians that cover less than this in every view of a finished map [px], and give up a sweep."""
        self._swept = 0
        self._begin()
        self._measure(self._densifier.keyframes, near, 0)
        self._remove(min_contribution, len(self._densifier.anchors))

    def _begin(self) -> None:
        self.contribution.begin()
        self._paging.away.sweep += 1
        self._left_out = []

    def _near(self, views: Sequence[Keyframe]) -> list[Keyframe]:
        """Return the views that are near, see `Paging.near`. The others are left out."""
        store = self._densifier.keyframes
        near = {store[place].index for place in self._paging.near().tolist()}
        self._left_out += [view for view in views if view.index not in near]
        return [view for view in views if view.index in near]

    def _measure(self, views: Iterable[Keyframe], near: float, level: int) -> None:
        """Measure views, each with all that it sees."""

        def complete() -> Iterator[Keyframe]:
            for view in views:
                self._paging.before_views([view])
                yield view

        self.contribution.measure(complete(), near, level)

    def _remove(self, min_contribution: float, young: int) -> None:
        """Remove what hardly showed, but not what the anchor `young`, a later one, or one that was left out placed."""
        gaussians = self._densifier.gaussians
        spared = self._densifier.anchors_at(self._left_out)
        spared[young:] = True
        spared = np.append(spared, False)  # for Gaussians without an anchor, whose place is -1
        gaussians.remove((gaussians.coverages() >= min_contribution) | spared[gaussians.anchors()])
        self._paging.away.remove_hidden(min_contribution, spared)

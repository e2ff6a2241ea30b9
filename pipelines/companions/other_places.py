"""`OtherPlaces`: keeps the places of a map from disturbing one another."""
# pyright: reportGeneralTypeIssues=false, reportInvalidTypeForm=false, reportOptionalSubscript=false

from collections.abc import Sequence

import numpy as np

from fields.map.keyframe import Keyframe
from fields.map.keyframes import FAR, centres_of
from fields.runtime.engine import ti
from pipelines.companions.companion import Companion
from pipelines.densify.densifier import Densifier

# Largest standard deviation of a Gaussian [scene depths]: three of them reach as far as a place.
LARGEST = FAR / 3.0
# What a larger one becomes, as a share of it. The scene depth changes as the map grows: what was limited once would
# otherwise be limited again, by a little, long after the camera has left.
SHRUNK = 0.8


@ti.data_oriented
class OtherPlaces(Companion):
    """Holds the Gaussians of other places while views of one place are optimised, and limits the size of all.

    While a map is young at a place apart, Gaussians of other places show through its holes. A step would have them grow
    until they fill these: a Gaussian of redkitchen grew from 0.2 to 9.5 scene depths within ten keyframes of a copy 15
    depths away, and its own views lost up to 7 dB. Gaussians also grow until they fill a hole at their own place, where
    no view may show that they are too large: one of 4.2 scene depths veiled the copy beside it, which lost 0.7 dB.
    """

    def __init__(self, densifier: Densifier) -> None:
        self.gaussians = densifier.gaussians
        self._densifier = densifier
        self._centres = np.zeros((0, 3))
        self._places = np.zeros(0, dtype=np.int64)

    def before_step(self) -> None:
        """Note where the keyframes are that have placed Gaussians.

        Does nothing, like `before_update`, if the map has no places apart, see `KeyframeStore.begins`.
        """
        store = self._densifier.keyframes
        if store.begins:
            self._centres = centres_of(store.selected)
            self._places = self._densifier.places_of_anchors()

    def before_update(self, views: Sequence[Keyframe]) -> None:
        """Limit the size of the Gaussians in memory, and clear the gradients of those far from each of the views.

        A Gaussian is far if the view that placed it is. Sizes are limited as soon as a second place begins, not when a
        view of that place first shows a Gaussian, so that what the camera has left stays as it was.
        """
        store = self._densifier.keyframes
        if self.gaussians.count and store.begins:
            held = store.far(self._centres, views)[self._places]
            self._hold(self.gaussians.count, held.astype(np.int32), float(np.log(LARGEST * store.scene_depth)))

    @ti.kernel
    def _hold(self, count: ti.i32, held: ti.types.ndarray(dtype=ti.i32, ndim=1), largest: ti.f32):
        for i in range(count):
            for axis in ti.static(range(3)):
                if self.gaussians.log_scale[i][axis] > largest:
                    self.gaussians.log_scale[i][axis] = largest + ti.static(float(np.log(SHRUNK)))
            if self.gaussians.touched[i] != 0:
                anchor = self.gaussians.anchor[i]
                if anchor >= 0 and held[ti.max(anchor, 0)] != 0:
                    self.gaussians.touched[i] = 0
                    self.gaussians.forget_gradient(i)

"""`OtherPlaces`: Gaussians that the views of a place apart show, but must not change."""
# pyright: reportGeneralTypeIssues=false, reportInvalidTypeForm=false, reportOptionalSubscript=false

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fields.map.keyframe import Keyframe
from fields.runtime.engine import ti
from pipelines.densify.densifier import Densifier

__all__ = ["OtherPlaces"]


@ti.data_oriented
class OtherPlaces:
    """Holds the Gaussians of other places while views of one place are optimised.

    While a map is young at a place apart, Gaussians of other places show through its holes. A step would have them grow
    until they fill these: a Gaussian of redkitchen grew from 0.2 to 9.5 scene depths within ten keyframes of a copy 15
    depths away, and its own views lost up to 7 dB.

    Args:
        densifier: Owner of the map's Gaussians and keyframes, and of the anchors.
    """

    def __init__(self, densifier: Densifier) -> None:
        self.gaussians = densifier.gaussians
        self._densifier = densifier

    def hold(self, views: Sequence[Keyframe]) -> None:
        """Clear the gradients of all Gaussians whose anchors are far from each of the views.

        Does nothing if the map has no places apart, see `KeyframeStore.place_begins`.

        Args:
            views: The views of an Adam step, whose gradients have been accumulated.
        """
        if self.gaussians.count and (held := self._held(views)).any():
            self._hold(self.gaussians.count, held.astype(np.int32))

    def _held(self, views: Sequence[Keyframe]) -> NDArray[np.bool_]:
        """Return which anchors (A,) are far from each of the views."""
        store = self._densifier.keyframes
        if not any(keyframe.begins_place for keyframe in store):
            return np.zeros(len(self._densifier.anchors), dtype=bool)
        far = store.far(store.selected, views)
        return self._densifier.anchors_at([store.selected[place] for place in np.flatnonzero(far)])

    @ti.kernel
    def _hold(self, count: ti.i32, held: ti.types.ndarray(dtype=ti.i32, ndim=1)):
        for i in range(count):
            anchor = self.gaussians.anchor[i]
            if self.gaussians.touched[i] != 0 and anchor >= 0 and held[ti.max(anchor, 0)] != 0:
                self.gaussians.touched[i] = 0
                self.gaussians.forget_gradient(i)

"""`HiddenGaussians`: removes Gaussians that hardly show in any keyframe, while the map grows."""

from __future__ import annotations

from fields.map.keyframes import Keyframe
from pipelines.densify.contribution import Contribution
from pipelines.densify.densifier import Densifier

__all__ = ["HiddenGaussians"]

# Number of keyframes before a sweep whose Gaussians may still grow, and are not removed.
YOUNG = 10
# Pyramid level of a sweep in parts, which is made while frames arrive. It takes half as long as at the full size.
COARSE = 1


class HiddenGaussians:
    """Sweeps over the keyframes, a few at a time or all at once, and then removes what hardly showed in any of them.

    A sweep spares the Gaussians that were placed in the `YOUNG` keyframes before it or while it went on.

    Args:
        contribution: Measures how much of each Gaussian shows.
        densifier: Owner of the map's Gaussians and keyframes.
        min_contribution: Coverage in the keyframe that shows most of a Gaussian, below which it is removed [px].
    """

    def __init__(self, contribution: Contribution, densifier: Densifier, min_contribution: float) -> None:
        self.contribution = contribution
        self._densifier = densifier
        self._min_contribution = min_contribution
        self._swept = 0
        self._young: Keyframe

    def sweep(self, count: int, near: float) -> None:
        """Measure the next keyframes. After the last one, Gaussians are removed, and the next sweep begins.

        Args:
            count: Number of keyframes.
            near: Depth below which nothing is drawn [scene units].
        """
        keyframes = self._densifier.keyframes.selected
        if count == 0 or not keyframes or self._min_contribution == 0.0:
            return
        if self._swept == 0:
            self.contribution.begin()
            self._young = keyframes[-min(YOUNG, len(keyframes))]
        level = 0 if count >= len(keyframes) else COARSE
        self.contribution.measure(keyframes[self._swept : self._swept + count], near, level)
        self._swept += count
        if self._swept >= len(keyframes):
            self._swept = 0
            gaussians = self._densifier.gaussians
            shows = gaussians.coverages() >= self._min_contribution
            gaussians.remove(shows | self._densifier.placed_since(self._young))

    def remove(self, min_contribution: float, near: float) -> None:
        """Remove all Gaussians of a finished map that hardly show in any view. A sweep that goes on is given up.

        Args:
            min_contribution: Coverage in the view that shows most of a Gaussian, below which it is removed [px].
            near: Depth below which nothing is drawn [scene units].
        """
        self._swept = 0
        self.contribution.begin()
        self.contribution.measure(self._densifier.keyframes, near)
        self._densifier.gaussians.remove(self._densifier.gaussians.coverages() >= min_contribution)

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fields.map.keyframes import KeyframeStore
from pipelines.densify.depth.epipolar import EpipolarDepth
from pipelines.settings import EpipolarSettings
from tests.pipelines.wall import frame

PIXELS = np.stack([a.ravel() for a in np.meshgrid(np.arange(8.5, 56), np.arange(8.5, 40))], axis=1)[::7]


def test_depth_along_epipolar_lines_is_that_of_the_cpu(on_both: Callable) -> None:
    def estimate() -> tuple[np.ndarray, np.ndarray]:
        store = KeyframeStore()
        views = [store.append(frame(i)) for i in range(4)]
        found = EpipolarDepth(EpipolarSettings(min_lead=0.0)).estimate(views[2], views, PIXELS)
        return found.depth, found.deviation

    (depth, deviation), (gpu_depth, gpu_deviation) = on_both(estimate)
    known = np.isfinite(deviation)
    assert known.mean() > 0.5
    # Rounding may decide for the next sample, or for and against a match, here and there. Measured: all are the same,
    # and depths differ by 6.5e-5 at most.
    same = np.isfinite(gpu_deviation) == known
    assert same.mean() > 0.98
    close = np.abs(np.log(gpu_depth / depth))[known & same] < 1e-3
    assert close.mean() > 0.98

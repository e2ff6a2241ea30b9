"""The estimators on redkitchen, against the tracked points that they were not shown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fields.frames.tracked_frame import SparsePoints
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from modp_ti.config.settings import SceneConfig
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.readers.colmap import ColmapSettings
from modp_ti.inputs.source_settings import SourceSettings
from pipelines.densify.depth.epipolar import EpipolarDepth
from pipelines.densify.depth.estimate import DepthEstimator, FusedDepth, point_depths
from pipelines.densify.depth.gaussian_process import GaussianProcessDepth, ImageGuidedDepth
from pipelines.settings import DepthSettings, EpipolarSettings

DATA = Path(__file__).resolve().parents[5] / "shared" / "data" / "redkitchen"
pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not DATA.is_dir(), reason="no redkitchen beside the project"),
]
VIEWS = (15, 25, 35, 45, 58)


@pytest.fixture(scope="module")
def views() -> list[Keyframe]:
    config = SceneConfig(
        source=SourceSettings(path=DATA / "images", scale=0.5, stop=310),
        tracker=ColmapSettings(path=DATA / "sparse/0"),
        output=Path("unused"),
    )
    store = KeyframeStore()
    return [store.append(frame) for frame in open_tracker(config)]


def held_back(view: Keyframe) -> tuple[Keyframe, np.ndarray, np.ndarray]:
    """The view without two thirds of its points, and the pixels and depths of these."""
    keep = np.arange(len(view.points)) % 3 == 0
    p = view.points
    shown, hidden = (SparsePoints(p.xyz[k], p.pixels[k], p.ids[k]) for k in (keep, ~keep))
    return replace(view, points=shown), *point_depths(replace(view, points=hidden))


def errors(estimator: DepthEstimator, views: list[Keyframe], limit: float) -> np.ndarray:
    """Relative errors of the estimates that are surer than the limit."""
    result = []
    for i in VIEWS:
        view, pixels, depth = held_back(views[i])
        estimate = estimator.estimate(view, views[i - 10 : i], pixels)
        result.append((np.abs(estimate.depth / depth - 1))[estimate.deviation < limit])
    return np.concatenate(result)


def test_fusion_is_closer_to_points_that_were_held_back_than_the_constant_process(views: list[Keyframe]) -> None:
    settings = DepthSettings()
    guided = ImageGuidedDepth(settings, np.random.default_rng(0))
    fused = errors(FusedDepth([guided, EpipolarDepth(EpipolarSettings())]), views, settings.max_deviation)
    constant = errors(GaussianProcessDepth(settings, np.random.default_rng(0)), views, 0.06)
    assert len(fused) > 0.3 * len(constant)
    assert np.median(fused) < 0.85 * np.median(constant)
    assert np.percentile(fused, 90) < 0.7 * np.percentile(constant, 90)

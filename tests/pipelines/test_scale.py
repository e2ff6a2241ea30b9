"""A monocular map has no unit: the whole scene times anything is the same map."""

from __future__ import annotations

import numpy as np
import pytest

from fields.runtime.backend import initialise
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from tests.pipelines.wall import frame

pytestmark = pytest.mark.slow

# Few and short steps: a step on a gradient of pure rounding is as long as any other.
SETTINGS = MappingSettings(optimise={"steps": 2, "batch": 6, "scale_rate": 3e-3}, densify={"warm_up": 2})
FRAMES = 5


def mapped(scale: float) -> tuple[dict[str, np.ndarray], np.ndarray, list[np.ndarray]]:
    """The Gaussians, the last view's picture and the keyframes' poses of a scene times `scale`, in scene units."""
    initialise("cpu")
    mapper = OnlineMapper(SETTINGS, 64, 48, seed=1)
    for i in range(FRAMES):
        mapper.process(frame(i, scale=scale))
    mapper.finish()
    state = mapper.gaussians.to_numpy()
    state["position"] = state["position"] / scale
    state["log_scale"] = state["log_scale"] - np.log(scale)
    view = mapper.keyframes[-1]
    picture = mapper.renderer.render(view.camera, view.T_camera_world, 0.01 * mapper.keyframes.scene_depth).colour
    poses = [k.T_camera_world.copy() for k in mapper.keyframes]
    for T in poses:
        T[:3, 3] /= scale
    return state, picture, poses


def test_the_whole_scene_times_a_number_is_the_same_map() -> None:
    """Up to a decision that rounding turns, of which Adam makes whole steps and seeding a few Gaussians of 1,400.

    In seven draws: counts differ by 0.8 % at most, the picture by 5e-3, poses by 1.3e-3.
    """
    unit, (state, picture, poses) = mapped(1.0), mapped(2.0**-7)  # a power of two, which is not rounded itself
    assert len(state["position"]) == pytest.approx(len(unit[0]["position"]), rel=0.02)
    for name in ("position", "log_scale", "opacity_logit", "sh"):
        here, there = (np.quantile(each[name], np.linspace(0.05, 0.95, 19), axis=0) for each in (state, unit[0]))
        np.testing.assert_allclose(here, there, atol=0.1, err_msg=name)
    assert np.abs(picture - unit[1]).mean() < 1e-2
    np.testing.assert_allclose(poses, unit[2], atol=5e-3)

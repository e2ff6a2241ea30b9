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
SETTINGS = MappingSettings(
    optimise={"steps": 2, "last_steps": 2, "batch": 6, "scale_rate": 3e-3}, densify={"warm_up": 2}
)
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


@pytest.fixture(scope="module")
def unit() -> tuple[dict[str, np.ndarray], np.ndarray, list[np.ndarray]]:
    return mapped(1.0)


# Powers of two, which round nothing: with 100, a decision of seeding flipped in one of four random streams.
@pytest.mark.parametrize("scale", [2.0**-7, 2.0**7])
def test_the_whole_scene_times_a_number_is_the_same_map(unit, scale: float) -> None:
    """Within rounding; how a round Gaussian turns is nothing else."""
    state, picture, poses = mapped(scale)
    for name in ("position", "log_scale", "opacity_logit", "sh"):
        difference = np.abs(state[name] - unit[0][name])
        assert np.median(difference) < 1e-3, name
        assert np.mean(difference > 1e-2) < 0.01, name
    assert len(state["quaternion"]) == len(unit[0]["quaternion"])
    # In twenty draws, a mean of 8e-6 and 4e-6 at most.
    assert np.abs(picture - unit[1]).mean() < 1e-4
    np.testing.assert_allclose(poses, unit[2], atol=5e-5)

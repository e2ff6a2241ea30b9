"""What goes wrong in a step is undone, counted and said."""

from __future__ import annotations

import numpy as np
import pytest

from fields.geometry.se3 import exp_se3
from fields.map.gaussians import GaussianField
from fields.map.keyframe import Keyframe
from pipelines.optimise.adam import Adam
from pipelines.optimise.poses import PoseRefinement
from pipelines.safeguards import Safeguards
from tests.pipelines.optimise.test_adam import RATES, N, load, set_gradients
from tests.pipelines.optimise.test_poses import POSE, black, tracked


@pytest.fixture(scope="module")
def gaussians(taichi_on_the_cpu: None) -> GaussianField:
    return GaussianField(1, max_gaussians=4096)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e25, -1e20])
@pytest.mark.parametrize("name", ["position", "log_scale", "quaternion", "opacity_logit", "sh"])
def test_a_gaussian_with_a_bad_gradient_keeps_all_that_it_is(gaussians: GaussianField, name: str, bad: float) -> None:
    state = load(gaussians)
    gradients = {key: np.ones(value.shape) for key, value in state.items()}
    gradients[name].reshape(N, -1)[3, -1] = bad
    set_gradients(gaussians, gradients, np.ones(N, dtype=bool))
    Adam(gaussians).step(RATES)
    after, history = gaussians.to_numpy(), gaussians.history()
    others = np.arange(N) != 3
    for key, value in state.items():
        np.testing.assert_array_equal(after[key][3], value[3])
        assert (after[key][others] != value[others]).all()
        assert (history[f"{key}_m"][3] == 0).all() and (history[f"{key}_v"][3] == 0).all()
        assert (gaussians.gradients_to_numpy()[key] == 0).all()
    assert history["steps"].tolist() == others.astype(int).tolist()
    assert gaussians.take_caught() == (1, 0)
    assert gaussians.take_caught() == (0, 0)


def test_large_gradients_that_are_numbers_are_stepped(gaussians: GaussianField) -> None:
    state = load(gaussians)
    gradients = {key: np.full(value.shape, 1e16) for key, value in state.items()}
    set_gradients(gaussians, gradients, np.ones(N, dtype=bool))
    Adam(gaussians).step(RATES)
    assert gaussians.take_caught() == (0, 0)
    np.testing.assert_allclose(gaussians.to_numpy()["position"], state["position"] - RATES.position, atol=1e-5)


def test_an_exploding_gaussian_becomes_transparent_so_that_pruning_takes_it(gaussians: GaussianField) -> None:
    state = load(gaussians)
    state["log_scale"] = np.minimum(state["log_scale"], 1.0)
    state["log_scale"][5] = [0.0, np.log(20.0) - 0.01, 1.0]
    gaussians.load(state)
    gradients = {key: np.zeros(value.shape) for key, value in state.items()}
    gradients["log_scale"][5] = -1.0  # the step makes it larger, by the rate
    set_gradients(gaussians, gradients, np.ones(N, dtype=bool))
    Adam(gaussians).step(RATES, largest=20.0)
    assert gaussians.take_caught() == (0, 1)
    opacity = gaussians.opacities()
    assert opacity[5] < 1e-8 and (np.delete(opacity, 5) > 1e-3).all()
    assert gaussians.to_numpy()["log_scale"].max() <= np.float32(np.log(20.0))


def test_a_camera_that_is_carried_away_stays_and_forgets_what_drove_it() -> None:
    view, poses = black(), PoseRefinement()
    T = view.T_camera_world.copy()
    poses.step(view, np.array([1.0, 0, 0, 0, 0, 0]), 500.0)  # px: the image is 64 wide
    np.testing.assert_array_equal(view.T_camera_world, T)
    assert not poses.moments.steps
    assert poses.safeguards.camera_steps == 1
    poses.step(view, np.array([1.0, 0, 0, 0, 0, 0]), 0.1)
    assert poses.safeguards.camera_steps == 1 and not np.array_equal(view.T_camera_world, T)


def test_an_alignment_that_runs_away_leaves_the_tracked_pose() -> None:
    """All points were tracked where none of them is: the least error lies far off."""
    view, poses = tracked(POSE), PoseRefinement()
    view.points.pixels[:] += [300.0, -250.0]
    poses.align(view)
    np.testing.assert_array_equal(view.T_camera_world, POSE)
    assert poses.safeguards.camera_steps == 1


def test_an_alignment_within_reach_is_not_held() -> None:
    view: Keyframe = tracked(exp_se3([0.05, 0, 0, 0, 0.02, 0]) @ POSE)
    poses = PoseRefinement()
    poses.align(view)
    np.testing.assert_allclose(view.T_camera_world, POSE, atol=1e-2)
    assert poses.safeguards.camera_steps == 0


def test_the_warning_names_what_was_caught_and_is_silent_otherwise() -> None:
    safeguards = Safeguards()
    assert safeguards.warning() is None
    safeguards.gaussian_steps, safeguards.exploded_gaussians = 1200, 3
    assert safeguards.warning() == (
        "guards: 1,200 steps of Gaussians with gradients that are no numbers were left out; "
        "3 Gaussians that had grown beyond all bounds were removed"
    )
    again = Safeguards()
    again.restore(safeguards.counts())
    assert again == safeguards

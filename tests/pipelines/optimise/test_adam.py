"""Adam against PyTorch, and the safeguards of steps of Gaussians and poses."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fields.map.gaussians import GaussianField
from pipelines.optimise.adam import Adam, LearningRates
from pipelines.optimise.poses import PoseRefinement
from tests.pipelines.optimise.test_poses import POSE, black, tracked

RATES = LearningRates(position=0.1, log_scale=0.2, quaternion=0.3, opacity_logit=0.4, colour=0.5)
N = 40


@pytest.fixture(scope="module")
def gaussians(taichi_on_the_cpu: None) -> GaussianField:
    return GaussianField(1, max_gaussians=4096)


def load(gaussians: GaussianField) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    shapes = {"position": (3,), "log_scale": (3,), "quaternion": (4,), "opacity_logit": (), "sh": (4, 3)}
    state = {name: rng.normal(size=(N, *shape)).astype(np.float32) for name, shape in shapes.items()}
    gaussians.load(state)
    return state


def set_gradients(gaussians: GaussianField, gradients: dict[str, np.ndarray], touched: np.ndarray) -> None:
    for name, gradient in gradients.items():
        field = getattr(gaussians, name).grad
        values = field.to_numpy()
        values[:N] = np.where(touched.reshape(-1, *[1] * (gradient.ndim - 1)), gradient, 0)
        field.from_numpy(values)
    marks = np.zeros(gaussians.touched.shape, dtype=np.int32)
    marks[:N] = touched
    gaussians.touched.from_numpy(marks)


@pytest.mark.parametrize("batch", [1, 6])
def test_steps_are_those_of_pytorch_and_untouched_gaussians_stay(gaussians: GaussianField, batch: int) -> None:
    state = load(gaussians)
    adam = Adam(gaussians)
    rng = np.random.default_rng(2)
    touched = rng.random(N) < 0.6
    root = np.sqrt(batch)
    tensors = {name: torch.tensor(value.astype(np.float64), requires_grad=True) for name, value in state.items()}
    constant, directional = (
        torch.tensor(state["sh"][:, :1].astype(np.float64), requires_grad=True),
        torch.tensor(state["sh"][:, 1:].astype(np.float64), requires_grad=True),
    )
    groups = [
        {"params": [tensors[name]], "lr": root * getattr(RATES, name)}
        for name in ("position", "log_scale", "quaternion", "opacity_logit")
    ]
    groups += [
        {"params": [constant], "lr": root * RATES.colour},
        {"params": [directional], "lr": root * RATES.colour / 20},
    ]
    oracle = torch.optim.Adam(groups, betas=(1 - 0.1 * batch, 1 - 0.001 * batch), eps=1e-15 / root)
    for _ in range(5):
        gradients = {name: rng.normal(size=value.shape) for name, value in state.items()}
        set_gradients(gaussians, gradients, touched)
        adam.step(RATES, batch)
        for name in ("position", "log_scale", "quaternion", "opacity_logit"):
            tensors[name].grad = torch.tensor(gradients[name])
        constant.grad = torch.tensor(gradients["sh"][:, :1])
        directional.grad = torch.tensor(gradients["sh"][:, 1:])
        oracle.step()
    expected = {name: tensor.detach().numpy() for name, tensor in tensors.items()}
    expected["sh"] = torch.cat([constant, directional], dim=1).detach().numpy()
    result = gaussians.to_numpy()
    for name, value in result.items():
        np.testing.assert_allclose(value[touched], expected[name][touched], rtol=2e-4, atol=2e-4)
        np.testing.assert_array_equal(value[~touched], state[name][~touched])
    steps = gaussians.steps.to_numpy()[:N]
    assert (steps[touched] == 5).all()
    assert (steps[~touched] == 0).all()


def test_harmonics_above_the_active_degree_wait(gaussians: GaussianField) -> None:
    state = load(gaussians)
    ones = {name: np.ones(value.shape) for name, value in state.items()}
    everything = np.ones(N, dtype=bool)
    set_gradients(gaussians, ones, everything)
    Adam(gaussians).step(RATES, sh_degree=0)
    result = gaussians.to_numpy()
    np.testing.assert_array_equal(result["sh"][:, 1:], state["sh"][:, 1:])
    assert (gaussians.sh_m.to_numpy()[:N, 1:] == 0).all()
    assert (gaussians.gradients_to_numpy()["sh"] == 0).all()
    np.testing.assert_allclose(result["sh"][:, 0], state["sh"][:, 0] - RATES.colour, rtol=1e-4, atol=1e-5)


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

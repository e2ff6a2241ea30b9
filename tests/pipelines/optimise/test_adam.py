from __future__ import annotations

import numpy as np
import pytest
import torch

from fields.map.gaussians import GaussianField
from pipelines.optimise.adam import Adam, LearningRates

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


def test_a_step_leaves_no_gradient_behind(gaussians: GaussianField) -> None:
    state = load(gaussians)
    set_gradients(gaussians, {name: np.ones(value.shape) for name, value in state.items()}, np.ones(N, dtype=bool))
    Adam(gaussians).step(RATES)
    for gradient in gaussians.gradients_to_numpy().values():
        assert (gradient == 0).all()
    assert (gaussians.touched.to_numpy() == 0).all()


def test_a_gradient_that_is_not_finite_moves_nothing(gaussians: GaussianField) -> None:
    state = load(gaussians)
    gradients = {name: np.zeros(value.shape) for name, value in state.items()}
    gradients["position"][3] = [np.nan, np.inf, -np.inf]
    set_gradients(gaussians, gradients, np.ones(N, dtype=bool))
    Adam(gaussians).step(RATES)
    np.testing.assert_array_equal(gaussians.to_numpy()["position"], state["position"])


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

"""`rasterize` in the GPU's form is that of the CPU."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from fields.runtime.backend import torch_device
from pipelines.render.rasterize import rasterize
from tests.pipelines.scenes import CAMERA, NEAR, POSE, random_gaussians

NAMES = ("position", "log_scale", "quaternion", "opacity_logit", "sh")


def picture_and_gradients() -> tuple[list[NDArray], list[NDArray]]:
    state, device = random_gaussians(60, seed=4, degree=1), torch_device()
    inputs = [torch.tensor(state[name], dtype=torch.float32, device=device, requires_grad=True) for name in NAMES]
    T = torch.tensor(POSE, requires_grad=True)
    picture = rasterize(*inputs, T_camera_world=T, camera=CAMERA, near=NEAR)
    assert {output.device.type for output in picture} == {device.type}
    loss = picture.image.square().sum() + picture.depth.sum() - picture.opacity.sum()
    gradients = torch.autograd.grad(loss, [*inputs, T])
    return [output.detach().cpu().numpy() for output in picture], [g.cpu().numpy() for g in gradients]


def test_pictures_and_gradients_are_those_of_the_cpu(on_both: Callable) -> None:
    (pictures, gradients), (gpu_pictures, gpu_gradients) = on_both(picture_and_gradients)
    for ours, theirs in zip(pictures, gpu_pictures, strict=True):
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-4)
    for ours, theirs in zip(gradients, gpu_gradients, strict=True):
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-3 * np.abs(ours).max())


def test_float64_is_refused(on_both: Callable) -> None:
    on_both(lambda: None)
    inputs = [torch.from_numpy(value) for value in random_gaussians(3, seed=4).values()]
    with pytest.raises(TypeError, match="float64"):
        rasterize(*inputs, T_camera_world=torch.eye(4), camera=CAMERA)

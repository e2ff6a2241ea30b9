from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from fields.geometry.se3 import (
    exp_se3,
    hat,
    interpolate_se3,
    inverse_se3,
    log_se3,
    matrix_from_quaternion,
    orthonormalised,
    quaternion_from_matrix,
    quaternions_from_matrices,
    torch_exp_se3,
)


def tangents() -> list[NDArray[np.float64]]:
    rng = np.random.default_rng(0)
    scales = (1.0, 1e-3, 1e-5, 1e-9, 0.0)
    direction = [axis / np.linalg.norm(axis) for axis in rng.normal(size=(len(scales), 3))]
    # Turns of less than half a circle, which the logarithm gives back as they were.
    return [
        np.concatenate([rng.normal(size=3), 2.5 * scale * axis]) for scale, axis in zip(scales, direction, strict=True)
    ]


@pytest.mark.parametrize("xi", tangents())
def test_exp_is_the_matrix_exponential(xi: NDArray) -> None:
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = hat(xi[3:]), xi[:3]
    np.testing.assert_allclose(exp_se3(xi), expm(twist), atol=1e-12)


@pytest.mark.parametrize("xi", tangents())
def test_log_undoes_exp(xi: NDArray) -> None:
    np.testing.assert_allclose(log_se3(exp_se3(xi)), xi, atol=1e-10)


def test_log_of_a_half_turn_is_a_half_turn() -> None:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, np.pi, 0]).as_matrix()
    assert np.linalg.norm(log_se3(T)[3:]) == pytest.approx(np.pi)


def test_the_inverse_undoes_a_motion() -> None:
    T = exp_se3([1, 2, 3, 0.4, -0.5, 0.6])
    np.testing.assert_allclose(inverse_se3(T) @ T, np.eye(4), atol=1e-14)


def test_interpolation_starts_and_ends_at_its_motions_and_moves_evenly() -> None:
    a, b = exp_se3([1, 2, 3, 0.1, 0.2, 0.3]), exp_se3([0, -1, 2, -0.5, 0.4, 0.0])
    np.testing.assert_allclose(interpolate_se3(a, b, 0.0), a, atol=1e-12)
    np.testing.assert_allclose(interpolate_se3(a, b, 1.0), b, atol=1e-12)
    middle = interpolate_se3(a, b, 0.5)
    np.testing.assert_allclose(middle @ inverse_se3(a), b @ inverse_se3(middle), atol=1e-12)


@pytest.mark.parametrize("seed", range(8))
def test_quaternions_are_those_of_scipy(seed: int) -> None:
    # Half turns too, where the trace gives no root.
    angle = np.pi if seed > 3 else 2.0
    axis = np.roll([1.0, 1e-9, 0.0], seed) if seed > 3 else np.random.default_rng(seed).normal(size=3)
    rotation = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    q = quaternion_from_matrix(rotation.as_matrix())
    x, y, z, w = rotation.as_quat()
    np.testing.assert_allclose(q * np.sign(q @ [w, x, y, z]), [w, x, y, z], atol=1e-9)
    np.testing.assert_allclose(matrix_from_quaternion(-3.0 * q), rotation.as_matrix(), atol=1e-9)


def test_one_quaternion_is_that_of_many() -> None:
    """To the last bit, since both are used for the same poses."""
    matrices = Rotation.random(1000, rng=0).as_matrix()
    np.testing.assert_array_equal([quaternion_from_matrix(R) for R in matrices], quaternions_from_matrices(matrices))


def test_the_nearest_motion_of_a_motion_with_noise_is_a_motion() -> None:
    rng = np.random.default_rng(1)
    T = exp_se3([1, 2, 3, 0.4, -0.5, 0.6])
    noisy = T.copy()
    noisy[:3, :3] += 1e-4 * rng.normal(size=(3, 3))
    near = orthonormalised(noisy)
    np.testing.assert_allclose(near[:3, :3] @ near[:3, :3].T, np.eye(3), atol=1e-14)
    assert np.linalg.det(near[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(near, T, atol=5e-4)


def test_the_torch_twin_is_the_same_and_differentiable() -> None:
    xi = torch.tensor(np.array(tangents()), requires_grad=True)
    np.testing.assert_allclose(torch_exp_se3(xi).detach(), [exp_se3(x) for x in tangents()], atol=1e-12)
    assert torch.autograd.gradcheck(torch_exp_se3, xi)

"""Rigid motions and similarities: laws of the group, against SciPy and PyTorch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from fields.geometry.se3 import (
    exp_se3,
    hat,
    interpolate_se3,
    inverse_se3,
    log_se3,
    matrix_from_quaternion,
    motion_around,
    moved_points,
    moved_pose,
    orthonormalised,
    quaternion_from_matrix,
    quaternions_from_matrices,
    scale_of,
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


quick = settings(derandomize=True, max_examples=60, deadline=None, database=None)

lengths = st.floats(-100, 100, allow_subnormal=False)
directions = st.tuples(*[st.floats(-1, 1, allow_subnormal=False)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)
# The closed forms and their series meet at 1e-4, and a half turn is where the logarithm has two answers.
angles = st.one_of(st.floats(0, 3.1), st.floats(0, 1e-3), st.just(0.0), st.just(1e-4))


@st.composite
def any_tangent(draw) -> np.ndarray:
    axis = np.array(draw(directions))
    omega = draw(angles) * axis / np.linalg.norm(axis)
    return np.concatenate([draw(st.tuples(lengths, lengths, lengths)), omega])


motions = any_tangent().map(exp_se3)
points = st.lists(st.tuples(lengths, lengths, lengths), min_size=2, max_size=6).map(np.array)


@quick
@given(any_tangent())
def test_exp_is_the_matrix_exponential_and_log_undoes_it(xi: np.ndarray) -> None:
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = hat(xi[3:]), xi[:3]
    T = exp_se3(xi)
    np.testing.assert_allclose(T, expm(generator), atol=1e-9 * (1 + np.abs(xi).max()))
    np.testing.assert_allclose(log_se3(T), xi, atol=1e-6 * (1 + np.abs(xi).max()))


@quick
@given(motions, motions)
def test_motions_are_a_group(A: np.ndarray, B: np.ndarray) -> None:
    AB = A @ B
    scale = 1 + np.abs(AB).max()
    np.testing.assert_allclose(AB[:3, :3] @ AB[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(inverse_se3(AB), inverse_se3(B) @ inverse_se3(A), atol=1e-12 * scale)
    np.testing.assert_allclose(inverse_se3(A), np.linalg.inv(A), atol=1e-10 * (1 + np.abs(A).max()))
    np.testing.assert_allclose(orthonormalised(AB), AB, atol=1e-12 * scale)


@quick
@given(motions, motions, st.floats(0, 1))
def test_a_screw_is_halved_by_its_middle(A: np.ndarray, B: np.ndarray, t: float) -> None:
    relative = np.real(logm((B @ np.linalg.inv(A))[:3, :3]))
    if np.linalg.norm(relative) > 4.2:  # close to a half turn, where either way is right
        return
    T = interpolate_se3(A, B, t)
    scale = 1e-8 * (1 + np.abs(A).max() + np.abs(B).max())
    np.testing.assert_allclose(T[:3, :3], expm(t * relative) @ A[:3, :3], atol=1e-7)
    np.testing.assert_allclose(interpolate_se3(T, B, 1.0), B, atol=scale)


@quick
@given(st.tuples(*[st.floats(-1, 1, allow_subnormal=False)] * 4).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_a_quaternion_and_its_matrix_are_the_same_rotation(q: tuple[float, ...]) -> None:
    R = matrix_from_quaternion(q)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0
    unit, again = np.array(q) / np.linalg.norm(q), quaternion_from_matrix(R)
    np.testing.assert_allclose(np.abs(unit @ again), 1.0, atol=1e-12)


@quick
@given(motions, motions, st.floats(0.01, 100), points)
def test_a_similarity_keeps_what_its_camera_sees_but_for_the_scale(
    before: np.ndarray, after: np.ndarray, scale: float, xyz: np.ndarray
) -> None:
    S = motion_around(before, after, scale)
    moved = moved_points(S, xyz)
    atol = 1e-9 * (1 + np.abs(xyz).max() + np.abs(before).max() + np.abs(after).max()) * max(scale, 1.0)
    seen_before = xyz @ before[:3, :3].T + before[:3, 3]
    seen_after = moved @ after[:3, :3].T + after[:3, 3]
    np.testing.assert_allclose(seen_after, scale * seen_before, atol=atol)
    np.testing.assert_allclose(scale_of(S), scale, rtol=1e-9)
    np.testing.assert_allclose(moved_pose(S, before), after, atol=atol * 100)
    np.testing.assert_allclose(np.linalg.norm(moved[0] - moved[1]), scale * np.linalg.norm(xyz[0] - xyz[1]), atol=atol)


BEFORE = exp_se3([0.3, -0.2, 0.4, 0.3, -0.5, 0.8])
AFTER = exp_se3([-1.0, 0.5, 0.2, 0.1, 0.9, -0.4])
XYZ = np.random.default_rng(0).normal(size=(20, 3))


def seen(T: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    return xyz @ T[:3, :3].T + T[:3, 3]


def test_what_a_camera_sees_goes_with_it_at_its_scale() -> None:
    S = motion_around(BEFORE, AFTER, 1.7)
    np.testing.assert_allclose(seen(AFTER, moved_points(S, XYZ)), 1.7 * seen(BEFORE, XYZ), atol=1e-12)
    assert scale_of(S) == pytest.approx(1.7)
    np.testing.assert_allclose(scale_of(np.stack([S, np.eye(4)])), [1.7, 1.0])


def test_another_camera_that_goes_with_the_world_sees_the_same() -> None:
    S = motion_around(BEFORE, AFTER, 0.6)
    np.testing.assert_allclose(moved_pose(S, BEFORE), AFTER, atol=1e-12)
    other = exp_se3([2.0, 0.1, -0.3, -0.2, 0.1, 0.7])
    T = moved_pose(S, other)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(seen(T, moved_points(S, XYZ)), 0.6 * seen(other, XYZ), atol=1e-12)


def test_a_pose_that_stays_moves_nothing_by_a_bit() -> None:
    S = motion_around(BEFORE, BEFORE.copy())
    np.testing.assert_array_equal(S, np.eye(4))
    np.testing.assert_array_equal(moved_pose(S, AFTER), AFTER)
    np.testing.assert_array_equal(moved_points(S, XYZ), XYZ)

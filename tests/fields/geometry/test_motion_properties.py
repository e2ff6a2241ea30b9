"""Properties of rigid motions and similarities, for any of them."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm, logm

from fields.geometry.se3 import (
    exp_se3,
    hat,
    interpolate_se3,
    inverse_se3,
    log_se3,
    matrix_from_quaternion,
    orthonormalised,
    quaternion_from_matrix,
)
from fields.geometry.similarity import motion_around, moved_points, moved_pose, scale_of

quick = settings(derandomize=True, max_examples=60, deadline=None, database=None)

lengths = st.floats(-100, 100, allow_subnormal=False)
directions = st.tuples(*[st.floats(-1, 1, allow_subnormal=False)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)
# The closed forms and their series meet at 1e-4, and a half turn is where the logarithm has two answers.
angles = st.one_of(st.floats(0, 3.1), st.floats(0, 1e-3), st.just(0.0), st.just(1e-4))


@st.composite
def tangents(draw) -> np.ndarray:
    axis = np.array(draw(directions))
    omega = draw(angles) * axis / np.linalg.norm(axis)
    return np.concatenate([draw(st.tuples(lengths, lengths, lengths)), omega])


motions = tangents().map(exp_se3)
points = st.lists(st.tuples(lengths, lengths, lengths), min_size=2, max_size=6).map(np.array)


@quick
@given(tangents())
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

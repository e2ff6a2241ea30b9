"""Rigid motions and similarities, the camera, and blocks of space: laws, against SciPy, OpenCV and PyTorch."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from fields.geometry.camera import PinholeCamera, pixel_metric
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
from fields.geometry.vec3 import cross, dot, rotate, rotate_back
from fields.map.blocks import Boxes, divide, planes_of, seen
from fields.runtime.engine import ti


def tangents() -> list[NDArray[np.float64]]:
    rng = np.random.default_rng(0)
    scales = (1.0, 1e-3, 1e-5, 1e-9, 0.0)
    direction = [axis / np.linalg.norm(axis) for axis in rng.normal(size=(len(scales), 3))]
    # Turns of less than half a circle, which the logarithm gives back as they were.
    return [
        np.concatenate([rng.normal(size=3), 2.5 * scale * axis]) for scale, axis in zip(scales, direction, strict=True)
    ]


def test_log_of_a_half_turn_is_a_half_turn() -> None:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, np.pi, 0]).as_matrix()
    assert np.linalg.norm(log_se3(T)[3:]) == pytest.approx(np.pi)


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


def test_a_pose_that_stays_moves_nothing_by_a_bit() -> None:
    S = motion_around(BEFORE, BEFORE.copy())
    np.testing.assert_array_equal(S, np.eye(4))
    np.testing.assert_array_equal(moved_pose(S, AFTER), AFTER)
    np.testing.assert_array_equal(moved_points(S, XYZ), XYZ)


CAMERA = PinholeCamera(500.0, 480.0, 310.0, 250.0, 640, 480)


def test_projection_is_that_of_opencv_with_centres_half_a_pixel_on() -> None:
    points = np.random.default_rng(0).uniform([-2, -2, 1], [2, 2, 6], (50, 3))
    K = CAMERA.matrix()
    K[:2, 2] -= 0.5
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, None)[0][:, 0] + 0.5
    np.testing.assert_allclose(CAMERA.project(points), expected, rtol=1e-9)


def test_unprojection_undoes_projection() -> None:
    points = np.random.default_rng(1).uniform([-2, -2, 1], [2, 2, 6], (50, 3))
    np.testing.assert_allclose(CAMERA.unproject(CAMERA.project(points), points[:, 2]), points, rtol=1e-12)


def test_a_resized_camera_sees_the_same_place_at_the_same_share_of_the_image() -> None:
    points = np.random.default_rng(2).uniform([-1, -1, 1], [1, 1, 6], (20, 3))
    small = CAMERA.resized(161, 119)
    np.testing.assert_allclose(small.project(points) / [161, 119], CAMERA.project(points) / [640, 480], rtol=1e-12)


def test_the_image_ends_before_its_width() -> None:
    pixels = np.array([[0, 0], [639.999, 479.999], [640, 10], [10, 480], [-0.001, 5]])
    assert CAMERA.contains(pixels).tolist() == [True, True, False, False, False]


VALUES = {"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, "width": 4, "height": 4}
NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize("value", [0, -3.0, 4.5, NAN, INF, "4", None])
@pytest.mark.parametrize("name", ["width", "height"])
def test_impossible_sizes_are_refused_in_one_line(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        PinholeCamera(**VALUES | {name: value})


@pytest.mark.parametrize(
    ("name", "value"), [("fx", 0.0), ("fy", -1.0), ("fx", NAN), ("fx", INF), ("cx", NAN), ("cy", INF)]
)
def test_impossible_intrinsics_are_refused_in_one_line(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        PinholeCamera(**VALUES | {name: value})


def test_numbers_of_any_type_become_plain_ones() -> None:
    camera = PinholeCamera(np.float64(60), np.float32(60), 32, np.int64(24), 64.0, np.int32(48))
    assert camera == PinholeCamera(60.0, 60.0, 32.0, 24.0, 64, 48)
    assert [type(value) for value in vars(camera).values()] == [float] * 4 + [int] * 2


LENS = PinholeCamera(40.0, 42.0, 21.0, 17.0, 43, 35)
DEPTH = 4.0


def test_a_unit_of_the_pixel_metric_moves_the_image_by_a_pixel() -> None:
    x, y = np.meshgrid((np.arange(5) + 0.5) / 5 * LENS.width, (np.arange(5) + 0.5) / 5 * LENS.height)
    pixels = np.tile(np.stack([x.ravel(), y.ravel()], axis=1), (2, 1))
    points = LENS.unproject(pixels, np.repeat([0.6 * DEPTH, 1.6 * DEPTH], 25))
    rng = np.random.default_rng(0)
    for _ in range(5):
        u = 1e-5 * rng.normal(size=6)
        T = exp_se3(pixel_metric(LENS, DEPTH) @ u)
        moved = LENS.project(points @ T[:3, :3].T + T[:3, 3]) - pixels
        assert np.sqrt((moved**2).sum(axis=1).mean()) == pytest.approx(np.linalg.norm(u), rel=1e-3)


def test_the_metric_follows_the_scale_of_the_scene() -> None:
    W, tenth = pixel_metric(LENS, DEPTH), pixel_metric(LENS, 0.1 * DEPTH)
    np.testing.assert_allclose(tenth[:3], 0.1 * W[:3], atol=1e-12)
    np.testing.assert_allclose(tenth[3:], W[3:], atol=1e-12)


def test_products_are_those_of_numpy() -> None:
    @ti.kernel
    def products(m: ti.types.ndarray(), a: ti.types.ndarray(), b: ti.types.ndarray(), out: ti.types.ndarray()):
        for _ in range(1):
            M = ti.Matrix([[m[r, c] for c in range(3)] for r in range(3)])
            u, v = ti.Vector([a[0], a[1], a[2]]), ti.Vector([b[0], b[1], b[2]])
            w, forth, back = cross(u, v), rotate(M, u), rotate_back(M, u)
            for c in ti.static(range(3)):
                out[0, c], out[1, c], out[2, c] = w[c], forth[c], back[c]
            out[3, 0] = dot(u, v)

    rng = np.random.default_rng(0)
    m, a, b = rng.normal(size=(3, 3)), rng.normal(size=3), rng.normal(size=3)
    out = np.zeros((4, 3))
    products(m, a, b, out)
    assert_allclose(out[0], np.cross(a, b), atol=1e-14)
    assert_allclose(out[1], m @ a, atol=1e-14)
    assert_allclose(out[2], m.T @ a, atol=1e-14)
    assert_allclose(out[3, 0], a @ b, atol=1e-14)


VIEW = PinholeCamera(60.0, 50.0, 30.0, 25.0, 64, 48)


@pytest.fixture
def spheres() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.normal(0.0, 3.0, (400, 3)), np.exp(rng.normal(-3.0, 1.5, 400))


def test_every_sphere_is_in_one_block_and_in_its_box(spheres: tuple[np.ndarray, np.ndarray]) -> None:
    position, extent = spheres
    blocks = divide(position, extent, 1.0)
    assert sorted(blocks.members.tolist()) == list(range(400))
    assert blocks.counts.sum() == 400 and (blocks.counts > 0).all()
    for block in range(len(blocks)):
        of = blocks.of(block)
        assert (np.diff(of) > 0).all()
        np.testing.assert_array_equal(blocks.boxes.low[block], (position[of] - extent[of, None]).min(axis=0))
        np.testing.assert_array_equal(blocks.boxes.high[block], (position[of] + extent[of, None]).max(axis=0))


def test_spheres_share_a_block_if_cube_and_size_class_agree(spheres: tuple[np.ndarray, np.ndarray]) -> None:
    position, extent = spheres
    blocks = divide(position, extent, 1.0)
    of = np.empty(400, dtype=int)
    for block in range(len(blocks)):
        of[blocks.of(block)] = block

    def key(i: int) -> tuple:
        side = 1.0
        while extent[i] > side / 4:
            side *= 2
        return (side, *np.floor(position[i] / side))

    keys = [key(i) for i in range(400)]
    for i in range(400):
        assert (of == of[i]).tolist() == [other == keys[i] for other in keys]


def test_no_box_reaches_farther_than_a_quarter_beyond_its_cube(spheres: tuple[np.ndarray, np.ndarray]) -> None:
    position, extent = spheres
    boxes = divide(position, np.minimum(extent, 0.25), 1.0).boxes
    assert (boxes.high - boxes.low <= 1.5 + 1e-9).all()


def test_what_a_view_draws_of_a_box_is_seen(spheres: tuple[np.ndarray, np.ndarray]) -> None:
    position, extent = spheres
    boxes = Boxes(position - extent[:, None], position + extent[:, None])
    poses = [exp_se3(np.random.default_rng(i).normal(0.0, 1.0, 6)) for i in range(12)]
    found = seen(np.array([planes_of(VIEW, T, 6.0) for T in poses]), boxes)
    # Points inside the boxes, projected one by one.
    inside = boxes.low + np.random.default_rng(1).uniform(0.0, 1.0, (50, 400, 3)) * (boxes.high - boxes.low)
    for T, flags in zip(poses, found, strict=True):
        p = inside.reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
        shown = (p[:, 2] > 0) & (p[:, 2] < 6.0)
        shown[shown] = VIEW.contains(VIEW.project(p[shown]))
        assert not (shown.reshape(50, 400).any(axis=0) & ~flags).any()
        assert flags.mean() < 0.6  # most of the world is beside the image, behind the camera or too far


def test_distances_are_to_the_nearest_point_of_a_box() -> None:
    boxes = Boxes(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]), np.array([[1.0, 1.0, 1.0], [2.0, 2.0, 1.0]]))
    np.testing.assert_allclose(boxes.distance(np.array([0.5, 0.5, 0.5])), [0.0, np.hypot(0.5, 0.5)])

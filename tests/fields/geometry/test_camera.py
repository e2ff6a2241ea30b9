"""The camera model, the metric of its pixels, and vectors in kernels."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from fields.geometry.camera import PinholeCamera, pixel_metric
from fields.geometry.se3 import exp_se3
from fields.geometry.vec3 import cross, dot, rotate, rotate_back
from fields.runtime.engine import ti

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

"""What the page shows: splats against SciPy, the browser's camera, and errors that are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fields.geometry.camera import PinholeCamera
from modp_ti.outputs.viewer.handover import BrowserCamera
from modp_ti.outputs.viewer.modes import Photograph, image_error, nearest_photograph, pinhole_of, splats_of
from pipelines.render.renderer import RenderedView

WALL = 4.0  # the plane z = 4 of the world, coloured by where it is


def browser(width: int, height: int, fov: float = 1.0, mode: str = "colour", **changes) -> BrowserCamera:
    values = {"wxyz": np.array([1.0, 0, 0, 0]), "position": np.zeros(3), "fov": fov} | changes
    return BrowserCamera(7, values["wxyz"], values["position"], values["fov"], width, height, mode)


@pytest.mark.parametrize("canvas", [(1920, 1080), (640, 480), (500, 900), (200, 100)])
def test_a_picture_has_the_shape_and_the_field_of_view_of_the_canvas(canvas: tuple[int, int]):
    camera, _ = pinhole_of(browser(*canvas, fov=0.9), 1.0, 320, 240)
    assert camera.width <= 320 and camera.height <= 240
    assert camera.width / camera.height == pytest.approx(canvas[0] / canvas[1], rel=0.02)
    assert 2 * np.arctan(camera.height / 2 / camera.fy) == pytest.approx(0.9)
    # A ray through the right edge of the canvas goes through the right edge of the picture.
    assert (camera.width / 2) / camera.fx == pytest.approx(np.tan(0.45) * canvas[0] / canvas[1])
    largest = camera.width in (320, canvas[0]) or camera.height in (240, canvas[1])
    assert largest


def test_the_pose_is_that_of_the_browser_in_the_worlds_units():
    turn = Rotation.from_euler("xyz", [0.3, -0.5, 1.0])
    centre = np.array([1.0, 2.0, 3.0])
    q = turn.as_quat(scalar_first=True)
    _, T = pinhole_of(browser(640, 480, wxyz=q, position=5.0 * centre), 5.0, 640, 480)
    np.testing.assert_allclose(T @ [*centre, 1.0], [0, 0, 0, 1], atol=1e-12)
    # What lies before the browser lies on the optical axis.
    np.testing.assert_allclose(T @ [*(centre + 2.0 * turn.apply([0, 0, 1])), 1.0], [0, 0, 2, 1], atol=1e-12)


@pytest.mark.parametrize(
    "nonsense",
    [
        browser(640, 480, fov=np.nan),
        browser(640, 480, fov=0.0),
        browser(0, 480),
        browser(640, 480, position=np.array([np.inf, 0, 0])),
        browser(640, 480, wxyz=np.zeros(4)),
        browser(100_000, 10),
    ],
)
def test_what_no_browser_can_mean_is_not_rendered(nonsense: BrowserCamera):
    assert pinhole_of(nonsense, 1.0, 640, 480) is None


def pose(x: float, yaw: float = 0.0) -> np.ndarray:
    """T_camera_world of a camera at (x, 0, 0)."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", yaw).as_matrix()
    T[:3, 3] = -T[:3, :3] @ [x, 0, 0]
    return T


def wall(camera: PinholeCamera, T: np.ndarray, offset: float = 0.0) -> RenderedView:
    """What a camera sees of the wall, by intersecting rays with it."""
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones_like(row)], axis=2)
    directions = rays @ T[:3, :3]
    centre = -T[:3, :3].T @ T[:3, 3]
    z = (WALL - centre[2]) / directions[..., 2]  # rays have z = 1 in the camera
    X = centre + z[..., None] * directions
    colour = 0.5 + 0.2 * np.stack([np.sin(X[..., 0]), np.cos(X[..., 1]), np.sin(X[..., 0] + X[..., 1])], axis=2)
    return RenderedView(np.float32(colour + offset), np.float32(z), np.ones_like(z, dtype=np.float32))


CAMERA = PinholeCamera(200.0, 200.0, 80.0, 60.0, 160, 120)


def photograph(T: np.ndarray, **changes) -> Photograph:
    rgba = np.full((120, 160, 4), 255, dtype=np.uint8)
    rgba[..., :3] = np.round(255 * wall(CAMERA, T).colour)
    return Photograph(rgba, CAMERA, T, **changes)


def test_from_its_own_place_the_error_is_the_plain_difference():
    T = pose(0.4, 0.1)
    picture = wall(CAMERA, T)
    rng = np.random.default_rng(0)
    shown = RenderedView(
        picture.colour + np.float32(rng.uniform(-0.1, 0.1, (120, 160, 3))), picture.depth, picture.opacity
    )
    taken = photograph(T)
    error = image_error(shown, CAMERA, T, taken, picture)
    expected = np.abs(shown.colour - taken.rgba[..., :3] / 255.0).mean(axis=2)
    inner = (slice(1, -1), slice(1, -1))
    np.testing.assert_allclose(error[inner], expected[inner], atol=1e-4)


def test_from_elsewhere_the_same_places_are_compared():
    here, there = pose(0.0), pose(0.7, -0.15)
    other = PinholeCamera(150.0, 160.0, 70.0, 45.0, 140, 90)
    exact = image_error(wall(other, here), other, here, photograph(there), wall(CAMERA, there))
    seen = np.isfinite(exact)
    assert 0.5 < seen.mean() < 1.0  # the photograph does not show all of it
    assert exact[seen].max() < 0.005  # 8 bits and interpolation
    brighter = image_error(wall(other, here, 0.1), other, here, photograph(there), wall(CAMERA, there))
    np.testing.assert_allclose(brighter[seen], 0.1, atol=0.005)


def test_what_is_hidden_from_the_photograph_has_no_error():
    here, there = pose(0.0), pose(0.2)
    seen = wall(CAMERA, there)
    seen.depth[:, :80] = 1.0  # something stands before the left half of its view
    error = image_error(wall(CAMERA, here), CAMERA, here, photograph(there), seen)
    # A point of the wall moves by 200 * 0.2 / 4 = 10 px.
    assert np.isnan(error[:, :89]).all()
    assert np.isfinite(error[1:-1, 91:-1]).all()


def test_masked_pixels_of_the_photograph_and_holes_of_the_map_have_no_error():
    T = pose(0.0)
    taken = photograph(T)
    taken.rgba[:40] = 0
    view = wall(CAMERA, T)
    view.opacity[:, :30] = 0.1
    known = np.isfinite(image_error(view, CAMERA, T, taken, wall(CAMERA, T)))
    assert not known[:40].any() and not known[:, :30].any()
    assert known[41:-1, 31:-1].all()


def test_exposure_and_vignette_of_the_photograph_are_no_error():
    T = pose(0.0)
    exposure = np.hstack([np.diag([1.2, 0.9, 1.1]), [[-0.05], [0.02], [0.0]]])
    vignette = np.full((120, 160, 3), 0.8, dtype=np.float32)
    picture = wall(CAMERA, T)
    taken = photograph(T, exposure=exposure, vignette=vignette)
    taken.rgba[..., :3] = np.round(255 * 0.8 * (picture.colour @ exposure[:, :3].T + exposure[:, 3]))
    error = image_error(picture, CAMERA, T, taken, picture)
    assert error[1:-1, 1:-1].max() < 0.005


def test_the_nearest_photograph_looks_at_the_same_things():
    poses = np.stack([pose(0.0, np.pi), pose(1.0), pose(0.3), pose(0.0, 0.8)])
    assert nearest_photograph(poses, pose(0.1), WALL) == 2


def some(count: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(4)
    return {
        "position": rng.normal(size=(count, 3)).astype(np.float32),
        "log_scale": rng.normal(-3, 0.5, (count, 3)).astype(np.float32),
        "quaternion": rng.normal(size=(count, 4)).astype(np.float32),
        "opacity_logit": rng.normal(size=count).astype(np.float32),
        "sh": rng.normal(0, 0.3, (count, 4, 3)).astype(np.float32),
    }


def test_splats_are_the_gaussians_in_the_units_of_the_page():
    state = some(50)
    splats = splats_of(state, 3.0, 100)
    assert splats.of == 50
    np.testing.assert_allclose(splats.centres, 3.0 * state["position"], rtol=1e-6)
    for i in range(50):
        R = Rotation.from_quat(state["quaternion"][i], scalar_first=True).as_matrix()
        expected = 9.0 * R @ np.diag(np.exp(2.0 * state["log_scale"][i])) @ R.T
        np.testing.assert_allclose(splats.covariances[i], expected, rtol=3e-4, atol=3e-6)
    np.testing.assert_allclose(splats.opacities[:, 0] / 255, 1 / (1 + np.exp(-state["opacity_logit"])), atol=0.002)
    # Of the harmonics only the constant one, 1 / (2 sqrt(pi)), is drawn.
    colour = np.clip(0.5 + state["sh"][:, 0] / (2 * np.sqrt(np.pi)), 0, 1)
    np.testing.assert_allclose(splats.colours / 255, colour, atol=0.002)


def test_of_a_large_map_a_subsample_is_drawn_that_covers_as_much():
    state = some(1000)
    splats = splats_of(state, 1.0, 250)
    assert len(splats.centres) == 250 and splats.of == 1000
    np.testing.assert_array_equal(splats.centres, state["position"][::4])
    areas = [np.prod(np.linalg.eigvalsh(c)) ** (1 / 3) for c in splats.covariances]
    expected = 4 * np.exp(2 * state["log_scale"][::4].mean(axis=1))
    np.testing.assert_allclose(areas, expected, rtol=1e-3)

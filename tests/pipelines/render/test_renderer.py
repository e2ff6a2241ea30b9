"""Pictures and contributions against plain twins."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.buffers.tiles import TILE_HEIGHT, TILE_WIDTH
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3
from fields.map.keyframes import KeyframeStore
from fields.runtime.engine import ti
from pipelines.companions.hidden_gaussians import Contribution
from pipelines.render.renderer import RenderedView, Renderer
from tests.pipelines import reference
from tests.pipelines.scenes import CAMERA, NEAR, POSE, random_gaussians

BACKGROUND = (0.2, 0.5, 0.9)


def render(
    renderer: Renderer,
    state: dict[str, NDArray],
    camera: PinholeCamera = CAMERA,
    pose: NDArray = POSE,
    background: tuple[float, float, float] = BACKGROUND,
) -> RenderedView:
    renderer.gaussians.load(state)
    return renderer.render(camera, pose, NEAR, background)


def assert_same_picture(view: RenderedView, picture: reference.Picture, tolerance: float = 1e-5) -> None:
    np.testing.assert_allclose(view.colour, picture.colour, rtol=0, atol=tolerance)
    np.testing.assert_allclose(view.opacity, picture.opacity, rtol=0, atol=tolerance)
    # Depth in units of the farthest one, so that the same digits count.
    np.testing.assert_allclose(view.depth, picture.depth, rtol=0, atol=tolerance * max(picture.depth.max(), 1.0))


def assert_bit_identical(a: RenderedView, b: RenderedView) -> None:
    np.testing.assert_array_equal(a.colour, b.colour)
    np.testing.assert_array_equal(a.depth, b.depth)
    np.testing.assert_array_equal(a.opacity, b.opacity)


def only(state: dict[str, NDArray], which: NDArray | slice) -> dict[str, NDArray]:
    return {name: value[which] for name, value in state.items()}


def joined(*states: dict[str, NDArray]) -> dict[str, NDArray]:
    return {name: np.concatenate([s[name] for s in states]) for name in states[0]}


def without_near_thresholds(n: int, seed: int, degree: int) -> tuple[dict[str, NDArray], reference.Picture]:
    """A scene in float32 in which rounding decides no threshold of alpha, and its picture: the first from this seed."""
    for further in range(100):
        state = random_gaussians(n, seed=seed + 1000 * further, degree=degree)
        state = {name: value.astype(np.float32) for name, value in state.items()}
        picture = reference.render(state, CAMERA, POSE, NEAR, BACKGROUND)
        if picture.margin > 1e-5:
            return state, picture
    raise AssertionError("every scene has an alpha at the threshold")


# ---- against the plain renderer -------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_float64_picture_is_that_of_the_reference(renderers: Callable[..., Renderer], degree: int) -> None:
    state = random_gaussians(60, seed=degree, degree=degree)
    picture = reference.render(state, CAMERA, POSE, NEAR, BACKGROUND)
    assert picture.opacity.max() > 0.7  # the scene says something
    assert_same_picture(render(renderers(degree, ti.f64), state), picture, 1e-6)


@pytest.mark.parametrize("degree", [0, 3])
def test_float32_picture_is_that_of_the_reference(renderers: Callable[..., Renderer], degree: int) -> None:
    for seed in (1, 2, 3):
        state, picture = without_near_thresholds(40, 10 * seed + degree, degree)
        assert_same_picture(render(renderers(degree, ti.f32), state), picture)


def test_needles_discs_and_what_lies_far_outside_the_image_are_those_of_the_reference(
    renderers: Callable[..., Renderer],
) -> None:
    """Axes of 0.03 to 30 pixels, and large Gaussians beside the camera, whose ellipses would blow up unlimited."""
    for state in (
        random_gaussians(40, seed=5, size=(0.03, 30.0), logit=(0.0, 4.0)),
        random_gaussians(40, seed=6, depth=(0.2, 2.0), size=(3.0, 30.0), beyond=1.5),
    ):
        picture = reference.render(state, CAMERA, POSE, NEAR, BACKGROUND)
        assert_same_picture(render(renderers(0, ti.f64), state), picture, 1e-6)


def test_a_tile_stops_behind_opaque_layers(renderers: Callable[..., Renderer]) -> None:
    """Sixty layers that cover the picture; at a logit of 9 alpha is clamped to 0.99."""
    for logit in (2.0, 9.0):
        state = random_gaussians(60, seed=7, size=(40.0, 60.0), logit=(logit, logit), beyond=-0.3)
        picture = reference.render(state, CAMERA, POSE, NEAR, BACKGROUND)
        assert picture.opacity.min() > 1 - 1e-5
        renderer = renderers(0, ti.f64)
        assert_same_picture(render(renderer, state), picture, 2e-5)
        tiles = -(-CAMERA.width // TILE_WIDTH) * -(-CAMERA.height // TILE_HEIGHT)
        reached, count = renderer.pairs.reached.to_numpy()[:tiles], renderer.pairs.tile_count.to_numpy()[:tiles]
        assert (reached < count).all()


def test_any_image_size_is_rendered_whole(renderers: Callable[..., Renderer]) -> None:
    for size in ((1, 1), (31, 33), (5, 17), (16, 16), (17, 16), (48, 32), (64, 64)):
        camera = PinholeCamera(40.0, 40.0, 0.45 * size[0], 0.55 * size[1], *size)
        state = random_gaussians(30, seed=8, camera=camera)
        view = render(renderers(0, ti.f64), state, camera)
        assert view.colour.shape == (size[1], size[0], 3)
        assert view.depth.shape == view.opacity.shape == (size[1], size[0])
        assert_same_picture(view, reference.render(state, camera, POSE, NEAR, BACKGROUND), 1e-6)


def test_equal_depths_are_composited_in_the_order_of_the_gaussians(renderer: Renderer) -> None:
    state = random_gaussians(12, seed=9, pose=np.eye(4), depth=(3.0, 3.0), size=(4.0, 9.0), logit=(1.0, 2.0))
    state["position"][:, 2] = 3.0  # to the bit
    picture = reference.render(state, CAMERA, np.eye(4), NEAR, BACKGROUND)
    swapped = reference.render(only(state, slice(None, None, -1)), CAMERA, np.eye(4), NEAR, BACKGROUND)
    assert np.abs(picture.colour - swapped.colour).max() > 0.05  # the order matters here
    assert_same_picture(render(renderer, state, pose=np.eye(4)), picture)


# ---- invariants -----------------------------------------------------------------------------------------------


def test_no_gaussians_give_the_background(renderer: Renderer) -> None:
    view = render(renderer, only(random_gaussians(1, seed=1), slice(0, 0)))
    np.testing.assert_array_equal(view.colour, np.broadcast_to(np.float32(BACKGROUND), view.colour.shape))
    assert (view.depth == 0).all()
    assert (view.opacity == 0).all()


def test_gaussians_that_the_view_does_not_see_change_no_bit(renderer: Renderer) -> None:
    state = random_gaussians(50, seed=2)
    alone = render(renderer, state)
    behind = random_gaussians(20, seed=3, depth=(-6.0, -0.5))
    behind["log_scale"] = np.full((20, 3), -1.0)
    too_near = random_gaussians(20, seed=4, depth=(0.2 * NEAR, 0.9 * NEAR))
    outside = random_gaussians(20, seed=5)
    outside["position"] += 30 * POSE[0, :3]  # along the camera's x axis
    transparent = random_gaussians(20, seed=6, logit=(-9.0, -6.0))
    assert_bit_identical(render(renderer, joined(behind, state, too_near, outside, transparent)), alone)


def test_a_picture_does_not_depend_on_those_before_it(renderer: Renderer) -> None:
    """A small image after a large one, one Gaussian after many: nothing of the earlier picture is left."""
    small = PinholeCamera(30.0, 30.0, 9.0, 7.0, 19, 13)
    first = render(renderer, random_gaussians(3, seed=12), small)
    large = PinholeCamera(60.0, 60.0, 32.0, 32.0, 64, 64)
    render(renderer, random_gaussians(300, seed=13, camera=large), large)
    assert_bit_identical(render(renderer, random_gaussians(3, seed=12), small), first)


def test_the_length_of_a_quaternion_does_not_matter(renderer: Renderer) -> None:
    state = random_gaussians(30, seed=16)
    first = render(renderer, state)
    state["quaternion"] *= -2.0  # a power of two: no rounding
    assert_bit_identical(render(renderer, state), first)


NONE = SparsePoints(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0, dtype=np.int64))


def weights(state: dict[str, np.ndarray], pose: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Sum of alpha T over the unmasked pixels, of every Gaussian, by the plain renderer."""
    splats = reference.project(state, CAMERA, pose, NEAR)
    total, T = np.zeros(len(state["position"])), np.ones(mask.shape)
    for i, alpha in zip(splats.index, splats.alpha(CAMERA.width, CAMERA.height), strict=True):
        drawn = np.where(alpha >= reference.ALPHA_MIN, np.minimum(alpha, reference.ALPHA_MAX), 0.0)
        total[i] = (drawn * T)[mask].sum()
        T = T * (1 - drawn)
    return total


@pytest.fixture
def store() -> KeyframeStore:
    """Two views, of which the second one's left half is masked."""
    mask = np.ones((CAMERA.height, CAMERA.width), dtype=bool)
    mask[:, :20] = False
    image = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.float32)
    other = exp_se3([0.4, 0.1, 0.0, 0.0, 0.2, 0.0]) @ POSE
    store = KeyframeStore()
    store.append(TrackedFrame(0, 0.0, "a", image, CAMERA, POSE, NONE))
    store.append(TrackedFrame(1, 0.1, "b", image, CAMERA, other, NONE, mask=mask))
    return store


def test_it_is_the_largest_sum_of_weights_over_the_views(
    renderers: Callable[..., Renderer], store: KeyframeStore
) -> None:
    renderer = renderers()
    state = random_gaussians(120, seed=4)
    renderer.gaussians.load(state)
    before = renderer.view_renders
    contribution = Contribution(renderer.gaussians, renderer)
    contribution.measure(store, NEAR)
    contribution.begin()
    for view in store:  # one after the other, as all at once
        contribution.measure([view], NEAR)
    measured = renderer.gaussians.coverages()
    masks = [view.rgba[..., 3] == 255 for view in store]
    expected = [weights(state, view.T_camera_world, mask) for view, mask in zip(store, masks, strict=True)]
    np.testing.assert_allclose(measured, np.maximum(*expected), rtol=1e-3, atol=1e-3)
    assert not np.array_equal(np.argmax(expected, axis=0), np.zeros(120))  # both views count
    assert renderer.view_renders == before + 4


def test_a_coarser_level_tells_nearly_the_same_pixels_of_the_full_size(renderers: Callable[..., Renderer]) -> None:
    renderer, camera = renderers(), PinholeCamera(50.0, 48.0, 31.0, 25.0, 64, 48)
    renderer.gaussians.load(random_gaussians(120, seed=1))
    store = KeyframeStore(levels=2)
    store.append(TrackedFrame(0, 0.0, "a", np.zeros((48, 64, 3), dtype=np.float32), camera, POSE, NONE))
    contribution, measured = Contribution(renderer.gaussians, renderer), []
    for level in (0, 1):
        contribution.begin()
        contribution.measure(store, NEAR, level)
        measured.append(renderer.gaussians.coverages())
    fine, coarse = measured
    assert fine.max() > 40
    assert np.abs(coarse - fine).max() < 3.0  # 0.8 to 1.4 over ten seeds
    assert coarse.sum() == pytest.approx(fine.sum(), rel=0.02)

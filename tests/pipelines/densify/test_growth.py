"""Seeds of new Gaussians, how they grow, what a wrong depth costs, and the first points of the offline baseline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3
from fields.map.gaussians import SH_C0, GaussianField
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from fields.voxels.occupancy import OccupancyVoxels
from pipelines.densify.adaptive_density import PointCloud, initialise, spacing, union_of_points
from pipelines.densify.depth.estimate import DepthEstimate, misplacement
from pipelines.densify.growth import Seeds, dissimilarity, error_pixels, grow, pixel_seeds, tracked_seeds
from pipelines.safeguards import MemoryBudget, Safeguards
from pipelines.settings import DensifySettings

CAMERA = PinholeCamera(100.0, 100.0, 80.0, 60.0, 160, 120)
POSE = exp_se3([0.3, -0.2, 0.4, 0.3, -0.5, 0.8])
RNG = np.random.default_rng(0)


def to_world(camera_points: np.ndarray) -> np.ndarray:
    return (camera_points - POSE[:3, 3]) @ POSE[:3, :3]


def view(count: int = 40, mask: np.ndarray | None = None) -> Keyframe:
    """A keyframe of noise with points all over it, and some that it does not see."""
    rng = np.random.default_rng(1)
    pixels = rng.uniform([0, 0], [160, 120], (count, 2))
    depth = rng.uniform(2, 6, count)
    pixels[:2] = [[-5, 30], [200, 30]]
    depth[2] = -3.0
    points = SparsePoints(to_world(CAMERA.unproject(pixels, depth)), pixels, np.arange(count))
    image = (rng.integers(0, 256, (120, 160, 3)) / 255).astype(np.float32)
    return KeyframeStore().append(TrackedFrame(0, 0.0, "v", image, CAMERA, POSE, points, mask))


class Wall:
    """A depth estimator that knows a wall at depth 5, on the left half only."""

    def estimate(self, view: Keyframe, neighbours, pixels: np.ndarray) -> DepthEstimate:
        return DepthEstimate(np.full(len(pixels), 5.0), np.where(pixels[:, 0] < 80, 0.01, 1.0))


def test_tracked_seeds_are_the_points_in_the_image_with_their_colour_and_size() -> None:
    v = view()
    seeds = tracked_seeds(v)
    np.testing.assert_allclose(seeds.xyz, v.points.xyz[3:])
    depth = (v.points.xyz[3:] @ POSE[2, :3]) + POSE[2, 3]
    np.testing.assert_allclose(seeds.size, depth / 100.0)  # Eq. 1
    column, row = v.points.pixels[3:].astype(int).T
    np.testing.assert_allclose(seeds.colour, v.rgba[row, column, :3] / 255)


def test_masked_pixels_seed_nothing() -> None:
    mask = np.zeros((120, 160), dtype=bool)
    mask[:60] = True
    seeds = tracked_seeds(view(mask=mask))
    pixels = CAMERA.project(seeds.xyz @ POSE[:3, :3].T + POSE[:3, 3])
    assert 0 < len(seeds) < 37
    assert (pixels[:, 1] < 60).all()


def test_dissimilarity_is_one_minus_ssim_of_grey_images() -> None:
    import cv2

    v = view()
    render = np.clip(v.rgba[..., :3] / 255 + RNG.normal(0, 0.1, (120, 160, 3)), 0, 1).astype(np.float32)

    def grey(image: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64), (5, 5), 0.5)

    _, expected = structural_similarity(
        grey(render), grey(v.rgba[..., :3]) / 255, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        data_range=1.0, full=True,
    )  # fmt: skip
    inside = (slice(8, -8), slice(8, -8))
    np.testing.assert_allclose(dissimilarity(render, v.rgba)[inside], 1 - expected[inside], atol=2e-3)


def test_error_pixels_are_distinct_centres_of_high_error_without_a_tracked_point() -> None:
    v = view()
    error = np.zeros((120, 160), dtype=np.float32)
    error[20:60, 30:90] = 0.5
    pixels = error_pixels(v, error, DensifySettings(pixels=1600), np.random.default_rng(2))
    assert len(pixels) == round(1600 * (160 * 120 / (640 * 480)) ** 0.75)
    assert len(np.unique(pixels, axis=0)) == len(pixels)
    np.testing.assert_array_equal(pixels % 1, 0.5)
    column, row = pixels.astype(int).T
    assert (error[row, column] > 0).all()
    tracked = {tuple(p) for p in v.points.pixels[3:].astype(int)}
    assert not tracked & set(zip(column.tolist(), row.tolist(), strict=True))


def test_an_image_that_is_mostly_wrong_has_error_pixels_in_proportion() -> None:
    v, settings = view(), DensifySettings(pixels=1600)
    half, whole = np.zeros((120, 160), dtype=np.float32), np.full((120, 160), 0.5, dtype=np.float32)
    half[:, :80] = 0.5
    few, many = (error_pixels(v, error, settings, np.random.default_rng(2)) for error in (half, whole))
    assert len(many) / len(few) == pytest.approx(2.0, rel=0.02)


def test_pixel_seeds_lie_on_their_rays_at_the_estimated_depth_where_it_is_known() -> None:
    pixels = np.array([[10.5, 20.5], [70.5, 100.5], [120.5, 60.5]])
    seeds = pixel_seeds(view(), [], pixels, Wall().estimate(view(), [], pixels), 0.06)
    local = seeds.xyz @ POSE[:3, :3].T + POSE[:3, 3]
    np.testing.assert_allclose(local[:, 2], 5.0)
    np.testing.assert_allclose(CAMERA.project(local), pixels[:2])
    np.testing.assert_allclose(seeds.size, 0.05)


def sideways(view: Keyframe, baseline: float) -> Keyframe:
    """The view from a camera that has moved to its right."""
    T = view.T_camera_world.copy()
    T[0, 3] -= baseline
    return replace(view, index=view.index + 1, T_camera_world=T)


def test_an_uncertain_pixel_is_seeded_where_its_error_would_hardly_be_seen() -> None:
    pixels = np.array([[70.5, 60.5], [120.5, 60.5]])  # of deviation 0.01, and 0.4

    class Vague(Wall):
        def estimate(self, view: Keyframe, neighbours, pixels: np.ndarray) -> DepthEstimate:
            return DepthEstimate(np.full(len(pixels), 5.0), np.where(pixels[:, 0] < 80, 0.01, 0.4))

    v = view()
    vague, wall = (estimator.estimate(v, [], pixels) for estimator in (Vague(), Wall()))
    near, far = [sideways(v, 0.1)], [sideways(v, 1.0)]  # 0.7 and 6.6 px
    assert len(pixel_seeds(v, near, pixels, vague, 0.06)) == 1
    assert len(pixel_seeds(v, near, pixels, vague, 0.06, max_misplacement=2.0)) == 2
    assert len(pixel_seeds(v, far, pixels, vague, 0.06, max_misplacement=2.0)) == 1
    assert len(pixel_seeds(v, near, pixels, wall, 0.06, max_misplacement=2.0)) == 1  # a deviation of 1 says nothing


@pytest.fixture(scope="module")
def gaussians(taichi_on_the_cpu: None) -> GaussianField:
    return GaussianField(1, max_gaussians=1024)


def unlimited(gaussians: GaussianField) -> MemoryBudget:
    return MemoryBudget(None, gaussians, KeyframeStore(), None, Safeguards())


def test_gaussians_begin_as_the_paper_says(gaussians: GaussianField) -> None:
    gaussians.remove(np.zeros(len(gaussians), dtype=bool))
    settings = DensifySettings()
    seeds = Seeds(np.array([[1.0, 2.0, 3.0]]), np.array([0.02]), np.array([[0.1, 0.5, 0.9]]))
    assert grow(gaussians, seeds, None, 1.0, settings, unlimited(gaussians)) == 1
    state = gaussians.to_numpy()
    np.testing.assert_allclose(state["position"], [[1, 2, 3]])
    np.testing.assert_allclose(state["log_scale"], np.log(0.5 * 0.02) + 0.5, rtol=1e-6)
    np.testing.assert_array_equal(state["quaternion"], [[1, 0, 0, 0]])
    assert gaussians.opacities() == pytest.approx(0.5)
    np.testing.assert_allclose(0.5 + SH_C0 * state["sh"][0, 0], [0.1, 0.5, 0.9], rtol=1e-6)
    assert (state["sh"][0, 1:] == 0).all()


def test_voxels_keep_gaussians_from_crowding(gaussians: GaussianField) -> None:
    gaussians.remove(np.zeros(len(gaussians), dtype=bool))
    voxels = OccupancyVoxels(1.0, levels=4)
    xyz = np.random.default_rng(4).uniform(0, 1, (400, 3)) * [1, 1, 0.05]
    seeds = Seeds(xyz, np.full(400, 0.1), np.full((400, 3), 0.5))
    budget = unlimited(gaussians)
    added = grow(gaussians, seeds, voxels, 0.25, DensifySettings(), budget)
    assert added == len(gaussians) == len(np.unique(np.floor(xyz / 0.25), axis=0))
    assert grow(gaussians, seeds, voxels, 0.25, DensifySettings(), budget) == 0
    assert grow(gaussians, seeds, voxels, 0.125, DensifySettings(), budget) > 0


def test_a_full_pool_takes_what_it_can(gaussians: GaussianField) -> None:
    gaussians.remove(np.zeros(len(gaussians), dtype=bool))
    seeds = Seeds(np.random.default_rng(5).normal(size=(1100, 3)), np.full(1100, 0.1), np.full((1100, 3), 0.5))
    budget = unlimited(gaussians)
    assert grow(gaussians, seeds, None, 1.0, DensifySettings(), budget) == 1024
    assert grow(gaussians, seeds, None, 1.0, DensifySettings(), budget) == 0
    assert budget.safeguards.gaussians_without_room == 76 + 1100


def test_a_misplacement_is_the_motion_of_the_pixel_in_the_views_that_see_it() -> None:
    v = view()
    pixels, depth, deviation = np.array([[80.5, 60.5], [158.5, 60.5]]), np.array([5.0, 5.0]), np.array([0.2, 0.2])
    others = [sideways(v, 0.5), sideways(v, 1.0)]
    moved = misplacement(v, others, pixels, depth, deviation)
    # A sideways camera sees a point at depth z at x - f b / z.
    expected = [100.0 * b * (1 / 5.0 - 1 / (5.0 * np.exp(0.2))) for b in (0.5, 1.0)]
    np.testing.assert_allclose(moved, np.sqrt(np.mean(np.square(expected))), rtol=1e-6)
    np.testing.assert_allclose(misplacement(v, [v], pixels, depth, deviation), 0.0, atol=1e-9)


SMALL = PinholeCamera(20.0, 20.0, 8.0, 6.0, 16, 12)


def placed(index: int, ids: list[int], pixels: list[tuple[float, float]], xyz: np.ndarray, red: float) -> Keyframe:
    """A view of one colour; its pixel in row 0, column 0 is masked."""
    image = np.tile(np.array([red, 0.2, 0.8], dtype=np.float32), (12, 16, 1))
    mask = np.ones((12, 16), dtype=bool)
    mask[0, 0] = False
    points = SparsePoints(xyz, np.array(pixels), np.array(ids))
    return KeyframeStore().view(TrackedFrame(index, 0.0, "v", image, SMALL, np.eye(4), points, mask))


def test_every_tracked_point_counts_once_as_the_last_view_that_shows_it_has_it() -> None:
    first = placed(0, [7, 3, 5, 9], [(4, 4), (5, 5), (6, 6), (0.5, 0.5)], np.arange(12.0).reshape(4, 3), 0.2)
    second = placed(1, [5, 3, 8], [(0.5, 0.5), (9, 9), (16.5, 3)], 100 + np.arange(9.0).reshape(3, 3), 0.6)
    cloud = union_of_points([first, second])
    # 5 is masked in the second view, 9 in its only one; 8 lies outside.
    np.testing.assert_array_equal(cloud.xyz, [[103, 104, 105], [6, 7, 8], [0, 1, 2]])
    np.testing.assert_allclose(cloud.colour, [[0.6, 0.2, 0.8], [0.2, 0.2, 0.8], [0.2, 0.2, 0.8]])


def test_spacing_is_the_mean_distance_of_the_three_nearest() -> None:
    # Far from the origin, as worlds of trackers are.
    xyz = np.random.default_rng(3).normal(size=(700, 3)) * [1, 5, 0.1] + 300
    distances = np.sort(np.linalg.norm(xyz[:, None] - xyz[None], axis=2), axis=1)
    np.testing.assert_allclose(spacing(xyz), distances[:, 1:4].mean(axis=1), rtol=1e-4)


def test_gaussians_begin_round_faint_and_as_wide_as_their_spacing() -> None:
    rng = np.random.default_rng(1)
    cloud = PointCloud(rng.normal(size=(30, 3)), rng.random((30, 3)))
    cloud.xyz[:4] = 9.0  # coincide
    gaussians = GaussianField(2, max_gaussians=1024)
    initialise(gaussians, cloud, opacity=0.1, smallest=1e-3)
    state = gaussians.to_numpy()
    np.testing.assert_allclose(state["position"], cloud.xyz, rtol=1e-6)
    width = np.maximum(spacing(cloud.xyz), 1e-3)
    np.testing.assert_allclose(np.exp(state["log_scale"]), np.repeat(width[:, None], 3, axis=1), rtol=1e-5)
    np.testing.assert_allclose(np.exp(state["log_scale"][:4]), 1e-3, rtol=1e-5)
    np.testing.assert_allclose(gaussians.opacities(), 0.1, rtol=1e-5)
    np.testing.assert_allclose(0.5 + SH_C0 * state["sh"][:, 0], cloud.colour, atol=1e-6)
    assert (state["sh"][:, 1:] == 0).all()
    np.testing.assert_array_equal(state["quaternion"], np.tile([1, 0, 0, 0], (30, 1)))


def test_a_smaller_pool_takes_points_from_everywhere() -> None:
    gaussians = GaussianField(0, max_gaussians=1024)
    xyz = np.stack([np.arange(4096.0), np.zeros(4096), np.zeros(4096)], axis=1)
    initialise(gaussians, PointCloud(xyz, np.zeros((4096, 3))), opacity=0.1, smallest=1e-3)
    np.testing.assert_allclose(gaussians.to_numpy()["position"][:, 0], np.arange(0, 4096, 4))

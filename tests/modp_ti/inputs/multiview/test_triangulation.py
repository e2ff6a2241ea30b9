"""Points are found where they are, whatever a wrong match says, and unclear ones are left out."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from modp_ti.inputs.multiview.features import detect_features, essential_matrix, match_features
from modp_ti.inputs.multiview.point_solving import placed_anew, solve_points
from modp_ti.inputs.multiview.reprojection import Observations
from modp_ti.inputs.multiview.triangulation import neighbouring_views

VIEWS, POINTS = 6, 80
SIGMA = 1 / 500


@pytest.fixture
def poses() -> np.ndarray:
    """Six cameras on an arc of 20 degrees around the origin, five units away."""
    T = np.tile(np.eye(4), (VIEWS, 1, 1))
    for i, angle in enumerate(np.linspace(-10, 10, VIEWS)):
        T[i, :3, :3] = Rotation.from_euler("yx", [angle, 3 * np.sin(i)], degrees=True).as_matrix()
        T[i, :3, 3] = [0.1 * i, 0, 5.0]
    return T


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (POINTS, 3))


def observed(poses: np.ndarray, points: np.ndarray) -> Observations:
    """Every point in every view, exactly."""
    frame, point = (each.ravel() for each in np.indices((len(poses), len(points))))
    p = np.einsum("mij,mj->mi", poses[frame, :3, :3], points[point]) + poses[frame, :3, 3]
    return Observations(frame, point, p[:, :2] / p[:, 2:], np.full(len(frame), SIGMA))


ALL = np.ones(VIEWS, bool)


def test_exact_observations_give_the_points(poses, points):
    xyz, kept = solve_points(poses, observed(poses, points), ALL)
    np.testing.assert_allclose(xyz, points, atol=1e-8)
    assert len(kept) == VIEWS * POINTS


def test_noise_of_half_a_pixel_moves_points_by_as_much_as_theory_says(poses, points):
    seen = observed(poses, points)
    noise = np.random.default_rng(1).normal(scale=0.5 * SIGMA, size=seen.rays.shape)
    xyz, _ = solve_points(poses, Observations(seen.frame, seen.point, seen.rays + noise, seen.sigma), ALL)
    assert len(xyz) >= 0.95 * POINTS
    # across: half a pixel at distance 5, six times: 0.5 * 5 / 500 / sqrt(6) = 0.002; along the rays, which
    # are up to 20 degrees apart, some eight times that (0.014 to 0.019 over five draws)
    error = np.linalg.norm(xyz[:, None] - points, axis=2).min(axis=1)
    assert 0.002 < np.median(error) < 0.03


def test_one_wrong_match_is_dropped_and_the_point_stays(poses, points):
    seen = observed(poses, points)
    rays = seen.rays.copy()
    wrong = (seen.point % 2 == 0) & (seen.frame == seen.point % VIEWS)
    rays[wrong] += 0.15  # 75 pixels
    xyz, kept = solve_points(poses, Observations(seen.frame, seen.point, rays, seen.sigma), ALL)
    np.testing.assert_allclose(xyz, points, atol=1e-6)
    right = seen.where(~wrong)
    assert np.array_equal(kept.frame, right.frame)
    assert np.array_equal(kept.point, right.point)


def test_points_that_two_views_alone_see_are_not_believed(poses, points):
    seen = observed(poses, points)
    few = (seen.point >= 10) | np.isin(seen.frame, [0, 5])
    xyz, _ = solve_points(poses, seen.where(few), ALL)
    np.testing.assert_allclose(xyz, points[10:], atol=1e-8)


def test_of_two_views_in_all_both_are_believed(poses, points):
    two = poses[[0, 5]]
    xyz, _ = solve_points(two, observed(two, points), np.ones(2, bool))
    np.testing.assert_allclose(xyz, points, atol=1e-7)


def test_points_without_parallax_or_behind_the_cameras_are_left_out(poses):
    far = np.array([[0.0, 0.0, 900.0], [3.0, 2.0, 900.0], [0.2, 0.1, 0.3]])
    xyz, kept = solve_points(poses, observed(poses, far), ALL)
    np.testing.assert_allclose(xyz, far[2:], atol=1e-8)
    assert set(kept.point) == {0}
    behind = observed(poses, np.array([[0.3, 0.2, -12.0]]))  # rays that meet behind the cameras
    assert len(solve_points(poses, behind, ALL)[0]) == 0


def test_cameras_that_only_turn_give_no_points(poses, points):
    poses[:, :3, 3] = 0
    xyz, kept = solve_points(poses, observed(poses, np.add(points, (0, 0, 5))), ALL)
    assert len(xyz) == len(kept) == 0


def test_views_that_do_not_solve_are_only_told_what_they_see(poses, points):
    seen = observed(poses, points)
    rays = seen.rays.copy()
    held_out = seen.frame == 2
    rays[held_out] += 1.2 * SIGMA
    solves = ALL.copy()
    solves[2] = False
    xyz, kept = solve_points(poses, Observations(seen.frame, seen.point, rays, seen.sigma), solves)
    np.testing.assert_allclose(xyz, points, atol=1e-8)
    assert np.count_nonzero(kept.frame == 2) == POINTS
    rays[held_out] += 5 * SIGMA
    xyz, kept = solve_points(poses, Observations(seen.frame, seen.point, rays, seen.sigma), solves)
    np.testing.assert_allclose(xyz, points, atol=1e-8)
    assert np.count_nonzero(kept.frame == 2) == 0


def test_points_are_placed_anew_under_other_poses_by_the_frames_that_may(poses, points):
    seen = observed(poses, points)
    rays = seen.rays.copy()
    rays[seen.frame == 2] += 10 * SIGMA  # held out
    seen = Observations(seen.frame, seen.point, rays, seen.sigma)
    solves = ALL.copy()
    solves[2] = False
    start = points + np.random.default_rng(2).normal(scale=0.02, size=points.shape)
    np.testing.assert_allclose(placed_anew(poses, seen, start, solves), points, atol=1e-6)
    few = seen.where((seen.point >= 10) | np.isin(seen.frame, [2, 4]))  # one frame that may sees the first ten
    moved = placed_anew(poses, few, start, solves)
    assert np.array_equal(moved[:10], start[:10])
    np.testing.assert_allclose(moved[10:], points[10:], atol=1e-6)
    assert np.array_equal(placed_anew(poses, seen.where(seen.frame < 0), start, solves), start)


def test_nothing_seen_gives_nothing(poses):
    none = Observations(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0))
    xyz, kept = solve_points(poses, none, ALL)
    assert xyz.shape == (0, 3) and len(kept) == 0


def test_views_are_paired_in_growing_gaps_and_with_those_that_come_back():
    T = np.tile(np.eye(4), (40, 1, 1))
    T[:, 0, 3] = -np.r_[np.arange(20), np.arange(20)[::-1] + 0.25]  # there and back
    pairs = neighbouring_views(T)
    assert {(0, 1), (0, 2), (0, 3), (0, 5)} <= set(pairs)
    assert (2, 37) in pairs, "frame 37 is back at the place of frame 2"
    assert all(a < b for a, b in pairs) and len(set(pairs)) == len(pairs)
    T[20:, :3, :3] = np.diag([-1, 1, -1])  # looking away on the way back
    assert not any(a < 20 <= b for a, b in neighbouring_views(T))


def test_essential_matrix_holds_for_corresponding_rays(poses, points):
    seen = observed(poses, points)
    E = essential_matrix(poses[1], poses[4])
    a, b = (np.c_[seen.rays[seen.frame == i], np.ones(POINTS)] for i in (1, 4))
    np.testing.assert_allclose(np.einsum("mi,ij,mj->m", b, E, a), 0, atol=1e-12)


def test_features_match_only_where_geometry_allows(plane_scene):
    images = [np.array(Image.open(plane_scene.folder / name)) for name in plane_scene.names[:2]]
    a, b = (detect_features(image) for image in images)
    K_inverse = np.linalg.inv(plane_scene.K)
    rays_a, rays_b = ((np.c_[f.pixels, np.ones(len(f.pixels))] @ K_inverse.T)[:, :2] for f in (a, b))
    T = plane_scene.T_camera_world
    E = essential_matrix(T[0], T[1])
    found = match_features(a.descriptors, b.descriptors, rays_a, rays_b, E, band=2 / 300).pairs
    assert len(found) > 100
    assert len(np.unique(found[:, 0])) == len(np.unique(found[:, 1])) == len(found)
    # oracle: the homography of the plane z = 0
    H = plane_scene.K @ T[1][:3, [0, 1, 3]] @ np.linalg.inv(plane_scene.K @ T[0][:3, [0, 1, 3]])
    moved = np.c_[a.pixels[found[:, 0]], np.ones(len(found))] @ H.T
    error = np.linalg.norm(moved[:, :2] / moved[:, 2:] - b.pixels[found[:, 1]], axis=1)
    assert np.median(error) < 0.3, "pixel centres are at +0.5 in both"
    assert (error < 2).mean() > 0.95
    unrelated = match_features(a.descriptors, b.descriptors, rays_a, rays_b, E + 0.3, band=2 / 300)
    assert len(unrelated) < 0.3 * len(found)
    assert len(match_features(a.descriptors[:1], b.descriptors, rays_a[:1], rays_b, E, 1.0)) == 0


def test_features_without_a_ray_are_not_matched(plane_scene):
    image = np.array(Image.open(plane_scene.folder / plane_scene.names[0]))
    found = detect_features(image)
    rays = np.full((len(found.pixels), 2), np.nan)
    assert len(match_features(found.descriptors, found.descriptors, rays, rays, np.eye(3), 1.0)) == 0


# The second is searched at a smaller size.
@pytest.mark.parametrize("size", [(300, 260), pytest.param((2400, 2080), marks=pytest.mark.slow)])
def test_features_lie_at_the_centres_of_blobs(size):
    width, height = size
    spread = width / 100
    centres = np.random.default_rng(0).uniform(0.1, 0.9, (40, 2)) * size
    y, x = np.mgrid[:height, :width] + 0.5
    image = np.full((height, width), 30.0)
    for cx, cy in centres:
        image += 150 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * spread**2))
    found = detect_features(np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, axis=2)).pixels
    offset = found[:, None] - centres
    nearest = np.linalg.norm(offset, axis=2).argmin(axis=1)
    offset = offset[np.arange(len(found)), nearest]
    close = np.linalg.norm(offset, axis=1) < spread / 2
    assert close.sum() > 40
    assert np.abs(np.median(offset[close], axis=0)).max() < 0.05 * max(1, width / 1000)


def test_image_without_features_has_none():
    found = detect_features(np.full((50, 60, 3), 128, np.uint8))
    assert found.pixels.shape == (0, 2) and found.descriptors.shape == (0, 128)

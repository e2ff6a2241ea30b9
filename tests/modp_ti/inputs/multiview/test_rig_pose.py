"""Poses of rigs, from observations of points that are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3
from modp_ti.config.camera_settings import PanoramaSettings
from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.klt.landmark_map import Keyframe, LandmarkMap
from modp_ti.inputs.multiview.rig_pose import refine_rig_pose, relative_rig_pose, rig_errors, rig_pose_from_points
from modp_ti.inputs.sources.panorama import Projection, faces_of

FACES = faces_of(PanoramaSettings(projection="equirectangular", faces=4, fov=100), Projection(1000, 500))
MOUNTS = np.stack([face.T_face_rig for face in FACES])
MOTION = exp_se3(np.array([0.3, 0.1, -0.2, 0.05, 0.2, -0.03]))


def observed(
    mounts: NDArray[np.float64], T_rig_world: NDArray[np.float64], xyz: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The camera that looks most directly at each point, and its normalised coordinates."""
    poses = mounts @ T_rig_world
    p = np.einsum("cij,nj->cni", poses[:, :3, :3], xyz) + poses[:, None, :3, 3]
    camera = p[..., 2].argmax(axis=0)
    p = p[camera, np.arange(len(xyz))]
    return camera, p[:, :2] / p[:, 2:]


@pytest.fixture
def points() -> NDArray[np.float64]:
    return np.random.default_rng(3).uniform(-4, 4, (300, 3))


def test_a_rig_is_placed_by_points_all_round_it(points: NDArray[np.float64]) -> None:
    camera, rays = observed(MOUNTS, MOTION, points)
    assert len(np.unique(camera)) == 4
    found = rig_pose_from_points(MOUNTS, camera, points, rays, 1e-3, seed=0)
    assert found is not None
    np.testing.assert_allclose(found, MOTION, atol=1e-9)
    assert rig_errors(MOTION, MOUNTS, camera, points, rays).max() < 1e-9


@pytest.mark.parametrize("apart", [0.0, 0.2], ids=["one centre", "cameras apart"])
def test_refinement_finds_the_pose_from_afar_and_despite_outliers(points: NDArray[np.float64], apart: float) -> None:
    mounts = MOUNTS.copy()
    mounts[:, :3, 3] = apart * np.eye(4)[:, :3]
    camera, rays = observed(mounts, MOTION, points)
    rays[::10] += 0.3
    found = refine_rig_pose(np.eye(4), mounts, camera, points, rays, 1e-2)
    np.testing.assert_allclose(found, MOTION, atol=1e-3)
    assert np.median(rig_errors(found, mounts, camera, points, rays)) < 1e-3


def test_the_motion_of_a_rig_is_found_up_to_its_length(points: NDArray[np.float64]) -> None:
    (camera_a, rays_a), (camera_b, rays_b) = (observed(MOUNTS, T, points) for T in (np.eye(4), MOTION))
    found = relative_rig_pose(MOUNTS, camera_a, camera_b, rays_a, rays_b, 1e-3, seed=0)
    assert found is not None
    np.testing.assert_allclose(found[:3, :3], MOTION[:3, :3], atol=1e-6)
    np.testing.assert_allclose(found[:3, 3], MOTION[:3, 3] / np.linalg.norm(MOTION[:3, 3]), atol=1e-6)


def test_bundle_adjustment_moves_the_views_of_a_rig_together(points: NDArray[np.float64]) -> None:
    lens, rng = Lens.pinhole(FACES[0].camera), np.random.default_rng(5)
    landmarks = LandmarkMap(lens, MOUNTS)
    ids = landmarks.new_ids(len(points))
    landmarks.xyz[ids], landmarks.known[ids] = points + 0.02 * rng.normal(size=points.shape), True
    true = [exp_se3(place * np.array([0.3, 0.1, -0.2, 0.05, 0.2, -0.03])) for place in range(4)]
    for place, T in enumerate(true):
        camera, rays = observed(MOUNTS, T, points)
        T = T if place < 2 else exp_se3(0.02 * rng.normal(size=6)) @ T
        for number, face in enumerate(FACES):
            mine = np.flatnonzero(camera == number)
            pixels = rays[mine] * face.camera.fx + (face.camera.cx, face.camera.cy)
            grey = np.zeros((1, 1), np.uint8)
            landmarks.add_keyframe(
                Keyframe(4 * place + number, MOUNTS[number] @ T, grey, ids[mine], pixels, rays[mine])
            )
    cost = landmarks.adjust(range(8, 16), range(8), steps=30)
    assert cost < 1e-6
    for place, T in enumerate(true):
        for number in range(4):
            pose = landmarks.keyframes[4 * place + number].T_camera_world
            np.testing.assert_allclose(pose, MOUNTS[number] @ T, atol=1e-4)
    np.testing.assert_allclose(landmarks.xyz[ids], points, atol=1e-2)

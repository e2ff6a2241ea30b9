from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fields.geometry.se3 import inverse_se3
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.densify.depth.epipolar import OUTSIDE, RADIUS, EpipolarDepth, plane_warp
from pipelines.settings import EpipolarSettings
from tests.pipelines.wall import CAMERA, frame, on_the_plane, pose

PIXELS = np.stack([a.ravel() for a in np.meshgrid(np.arange(8.5, 56), np.arange(8.5, 40))], axis=1)[::7]
# The wall's waves are long: a lead over places nearby would not be there.
SETTINGS = EpipolarSettings(min_lead=0.0)


@pytest.fixture(scope="module")
def store() -> KeyframeStore:
    store = KeyframeStore()
    for i in range(5):
        store.append(frame(i))
    return store


def truth(pixels: np.ndarray, i: int) -> np.ndarray:
    T = pose(i)
    return on_the_plane(pixels, T) @ T[2, :3] + T[2, 3]


def painted(store: KeyframeStore, paint) -> list[Keyframe]:
    """The keyframes with other pictures on the wall: paint(xyz (N, 3)) gives colours (N, 3) in [0, 255]."""
    x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    every = np.stack([x.ravel(), y.ravel()], axis=1)
    views = []
    for k in store:
        rgba = k.rgba.copy()
        rgba[..., :3] = paint(on_the_plane(every, k.T_camera_world)).reshape(48, 64, 3)
        views.append(replace(k, rgba=rgba))
    return views


def score(grey, others, warps, pixels, inverse, floor: float = OUTSIDE) -> np.ndarray:
    """Scores (N, samples) of pixels at every inverse depth."""
    scores = np.empty((len(pixels), len(inverse)), dtype=np.float32)
    sizes = np.tile(np.array(others.shape[:0:-1], dtype=np.int32), (len(others), 1))
    first = np.zeros(len(pixels), dtype=np.int32)
    EpipolarDepth(SETTINGS)._score(grey, others, sizes, warps, pixels, inverse, first, floor, scores)
    return scores


def test_the_wall_is_found_to_a_part_of_a_pixel(store: KeyframeStore) -> None:
    estimate = EpipolarDepth(SETTINGS).estimate(store[2], list(store), PIXELS)
    known = np.isfinite(estimate.deviation)
    error = np.abs(np.log(estimate.depth / truth(PIXELS, 2)))[known]
    # A pixel between views 0 and 2 is depth / (focal * baseline) = 7 percent of the depth.
    assert known.mean() > 0.5
    assert np.median(error) < 0.02
    assert np.mean(error < 3 * estimate.deviation[known]) > 0.9


def test_scores_are_the_correlation_of_patches_carried_over_at_that_depth(store: KeyframeStore) -> None:
    """Against a plain twin: unproject, transform, project, sample, correlate."""
    view, other = store[2], store[0]
    grey = np.random.default_rng(0).uniform(size=(48, 64)).astype(np.float32)
    there = np.random.default_rng(1).uniform(size=(48, 64)).astype(np.float32)
    inverse = np.array([0.2, 0.25, 0.3], dtype=np.float32)
    pixels = np.array([[30.5, 20.5], [12.5, 33.5]], dtype=np.float32)
    warp = plane_warp(view.camera, view.T_camera_world, other.camera, other.T_camera_world)[None].astype(np.float32)
    scores = score(grey, there[None], warp, pixels, inverse)
    T = other.T_camera_world @ inverse_se3(view.T_camera_world)
    steps = np.arange(-RADIUS, RADIUS + 1.0)
    offsets = np.stack([a.ravel() for a in np.meshgrid(steps, steps)], axis=1)
    for n, pixel in enumerate(pixels.astype(float)):
        patch = pixel + offsets
        a = grey[np.floor(patch[:, 1]).astype(int), np.floor(patch[:, 0]).astype(int)].astype(float)
        for s, w in enumerate(inverse.astype(float)):
            xyz = CAMERA.unproject(patch, np.full(len(patch), 1 / w)) @ T[:3, :3].T + T[:3, 3]
            q = CAMERA.project(xyz) - 0.5
            x, y = np.floor(q).astype(int).T
            u, v = (q - np.floor(q)).T
            b = (there[y, x] * (1 - u) + there[y, x + 1] * u) * (1 - v) + (
                there[y + 1, x] * (1 - u) + there[y + 1, x + 1] * u
            ) * v
            # White noise in a wide image shows most that the patch is turned and scaled to first order only: off by
            # 1.3e-3 to 3.9e-3 over twenty seeds.
            assert scores[n, s] == pytest.approx(np.corrcoef(a, b)[0, 1], abs=7e-3)


def test_a_sample_is_given_up_only_where_it_cannot_reach_the_floor(store: KeyframeStore) -> None:
    """The view itself agrees wholly; once the second neighbour has not, the third cannot lift the mean to the floor."""
    grey, *others = np.random.default_rng(0).uniform(size=(3, 48, 64)).astype(np.float32)
    others = np.stack([grey, *others])
    warps = np.stack(
        [
            plane_warp(store[2].camera, store[2].T_camera_world, store[i].camera, store[i].T_camera_world)
            for i in (2, 0, 1)
        ]
    ).astype(np.float32)
    pixels, inverse = PIXELS.astype(np.float32), np.linspace(0.15, 0.4, 30).astype(np.float32)
    exact = score(grey, others, warps, pixels, inverse)
    bounds = score(grey, others, warps, pixels, inverse, floor=0.7)
    given_up = bounds - exact > 0.01  # the third would have to agree to 0.97; rounding is 1e-6
    assert 0.3 < given_up.mean() < 0.99
    assert (exact <= bounds + 1e-6).all()
    assert (bounds[given_up] < 0.7).all()
    np.testing.assert_allclose(bounds[bounds >= 0.7], exact[bounds >= 0.7], rtol=1e-6)


def test_stripes_that_fit_at_several_depths_are_left_out_for_the_lead_they_lack(store: KeyframeStore) -> None:
    def stripes(xyz: np.ndarray) -> np.ndarray:
        return np.repeat(127 + 120 * np.sin(34 * xyz[:, :1]), 3, axis=1)

    views = painted(store, stripes)
    pair = [views[4], views[0]]  # far enough apart to be a stripe's width off within the range

    def known(min_lead: float) -> float:
        estimate = EpipolarDepth(EpipolarSettings(min_lead=min_lead)).estimate(pair[0], pair, PIXELS)
        return float(np.isfinite(estimate.deviation).mean())

    assert known(0.0) > 0.3
    assert known(0.1) < 0.5 * known(0.0)


def test_scale_changes_the_depth_and_not_its_deviation(store: KeyframeStore) -> None:
    small = KeyframeStore()
    for i in range(5):
        small.append(frame(i, scale=0.01))
    one = EpipolarDepth(SETTINGS).estimate(store[2], list(store), PIXELS)
    hundredth = EpipolarDepth(SETTINGS).estimate(small[2], list(small), PIXELS)
    known = np.isfinite(one.deviation) & np.isfinite(hundredth.deviation)
    assert known.sum() > 0.95 * np.isfinite(one.deviation).sum()
    np.testing.assert_allclose(hundredth.depth[known], 0.01 * one.depth[known], rtol=1e-3)

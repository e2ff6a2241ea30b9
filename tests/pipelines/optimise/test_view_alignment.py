"""The pose of a picture of a wall, refined against Gaussians on the wall."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3
from fields.map.gaussians import SH_C0, GaussianField
from pipelines.optimise.view_alignment import ViewAlignment
from pipelines.render.renderer import Renderer
from tests.pipelines.wall import CAMERA, frame, on_the_plane, pose, texture

NEAR = 0.05
GAIN = np.array([0.6, 0.75, 0.7], np.float32)


@pytest.fixture(scope="module")
def alignment() -> ViewAlignment:
    """Half-transparent Gaussians on the wall, a pixel apart, beyond the edges of the picture too."""
    x, y = np.meshgrid(np.arange(-16, 80, 0.8), np.arange(-16, 64, 0.8))
    xyz = on_the_plane(np.stack([x.ravel(), y.ravel()], axis=1), pose(3))
    count, size = len(xyz), 0.7 * 4.0 / CAMERA.focal
    gaussians = GaussianField(0, count)
    gaussians.load(
        {
            "position": xyz.astype(np.float32),
            "log_scale": np.full((count, 3), np.log(size), np.float32),
            "quaternion": np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
            "opacity_logit": np.zeros(count, np.float32),
            "sh": ((texture(xyz) - 0.5) / SH_C0).astype(np.float32)[:, None],
        }
    )
    return ViewAlignment(Renderer(gaussians, CAMERA.width, CAMERA.height), NEAR)


def motion(T: NDArray[np.float64]) -> float:
    """Root mean square distance [px] between the wall's points as seen from T and from the true pose."""
    xyz = frame(3).points.xyz
    seen = [CAMERA.project(xyz @ P[:3, :3].T + P[:3, 3]) for P in (T, pose(3))]
    return float(np.sqrt(((seen[0] - seen[1]) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("gain", [np.ones(3, np.float32), GAIN], ids=["as mapped", "darker"])
def test_a_moved_pose_comes_back(alignment: ViewAlignment, gain: NDArray[np.float32]) -> None:
    """The picture is the map's own, since its Gaussians do not draw the wall without a bias."""
    picture = np.clip(alignment.renderer.render(CAMERA, pose(3), NEAR).colour, 0, 1).astype(np.float32)
    moved = exp_se3([0.04, -0.03, 0.05, 0.006, 0.008, -0.01]) @ pose(3)
    assert motion(moved) > 0.8
    T = alignment.refine(picture * gain, None, CAMERA, moved, frame(3).points)
    assert motion(T) < 0.2 * motion(moved)


def test_pixels_that_are_not_valid_do_not_count(alignment: ViewAlignment) -> None:
    view = frame(3)
    moved = exp_se3([0.04, -0.03, 0.05, 0.006, 0.008, -0.01]) @ pose(3)
    valid = np.ones((CAMERA.height, CAMERA.width), bool)
    valid[:, 40:] = False
    spoilt = view.image.copy()
    spoilt[:, 40:] = np.random.default_rng(0).random((CAMERA.height, 24, 3), dtype=np.float32)
    kept = [alignment.refine(image, valid, CAMERA, moved, view.points) for image in (view.image, spoilt)]
    np.testing.assert_array_equal(kept[0], kept[1])


def test_a_view_of_nothing_keeps_its_pose(alignment: ViewAlignment) -> None:
    view = frame(3)
    away = exp_se3([0, 0, 0, 0, np.pi, 0]) @ pose(3)
    np.testing.assert_array_equal(alignment.refine(view.image, None, CAMERA, away, view.points), away)

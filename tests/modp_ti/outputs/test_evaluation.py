"""Scores of frames and trajectories, against their definitions."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from fields.runtime.backend import initialise
from modp_ti.outputs.evaluation import (
    FrameScore,
    MapVersion,
    StillScore,
    absolute_trajectory_error,
    evaluate,
    explained_detail,
    score_frame,
    summary,
    umeyama,
)
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from tests.pipelines.wall import FRAMES, WALKED, still, walked, walker

WHOLE = np.ones((40, 60), dtype=bool)


def test_the_summary_holds_means_and_nothing_where_there_are_no_frames() -> None:
    assert summary([]) == {"psnr": None, "ssim": None, "lpips": None, "detail": None, "count": 0}
    scores = [FrameScore(0, "a", True, "online", 20.0, 0.5, None), FrameScore(1, "b", False, "online", 30.0, 0.7, None)]
    assert summary(scores) == {"psnr": 25.0, "ssim": 0.6, "lpips": None, "detail": None, "count": 2}
    scores = [replace(score, lpips=0.1 + 0.2 * score.index) for score in scores]
    assert summary(scores)["lpips"] == 0.2


@pytest.mark.parametrize("with_scale", [True, False])
def test_a_known_similarity_is_found(with_scale: bool) -> None:
    rng = np.random.default_rng(1)
    source = rng.normal(size=(20, 3))
    R = Rotation.random(random_state=2).as_matrix()
    s = 3.5 if with_scale else 1.0
    found_s, found_R, found_t = umeyama(source, s * source @ R.T + [1.0, -2.0, 3.0], with_scale)
    assert found_s == pytest.approx(s)
    np.testing.assert_allclose(found_R, R, atol=1e-12)
    np.testing.assert_allclose(found_t, [1.0, -2.0, 3.0], atol=1e-12)


def test_a_mirrored_cloud_is_answered_by_a_rotation() -> None:
    source = np.random.default_rng(3).normal(size=(20, 3))
    assert np.linalg.det(umeyama(source, source * [-1.0, 1.0, 1.0])[1]) == pytest.approx(1.0)


def poses(centres: np.ndarray) -> list[np.ndarray]:
    result = []
    for i, centre in enumerate(centres):
        T = np.eye(4)
        T[:3, :3] = Rotation.random(random_state=i).as_matrix()
        T[:3, 3] = -T[:3, :3] @ centre
        result.append(T)
    return result


def test_the_trajectory_error_is_that_of_the_centres_after_alignment() -> None:
    rng = np.random.default_rng(4)
    centres = rng.normal(size=(40, 3))
    noise = rng.normal(scale=0.01, size=(40, 3))
    turned = 0.2 * (centres + noise) @ Rotation.random(random_state=9).as_matrix() + [4.0, 5.0, 6.0]
    error = absolute_trajectory_error(poses(turned), poses(centres))
    # Alignment can only take away from the plain error, and seven numbers take little from 120.
    plain = np.sqrt((noise**2).sum(axis=1).mean())
    assert 0.9 * plain < error <= plain


def test_scale_is_an_error_where_it_must_not_be_aligned() -> None:
    centres = np.random.default_rng(5).normal(size=(10, 3))
    assert absolute_trajectory_error(poses(2 * centres), poses(centres)) == pytest.approx(0.0, abs=1e-12)
    assert absolute_trajectory_error(poses(2 * centres), poses(centres), with_scale=False) > 0.5


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=(40, 60, 3)).astype(np.float32)


def test_the_image_itself_explains_all_and_a_constant_nothing() -> None:
    image = noise(0)
    assert explained_detail(image, image, WHOLE) == 1.0
    assert explained_detail(np.full_like(image, 0.3), image, WHOLE) == pytest.approx(0.0, abs=1e-5)
    assert explained_detail(image, np.full_like(image, 0.5), np.zeros_like(WHOLE)) is None


def test_it_is_the_share_of_the_band_above_a_blur_of_one_pixel() -> None:
    image, render = noise(1), 0.7 * noise(1) + 0.3 * noise(2)

    def band(picture: np.ndarray) -> np.ndarray:
        return picture - gaussian_filter(picture.astype(np.float64), (1, 1, 0), mode="mirror", truncate=3.0)

    expected = 1 - np.square(band(image - render)).sum() / np.square(band(image)).sum()
    # OpenCV cuts the Gaussian off at another radius than SciPy.
    assert explained_detail(render, image, WHOLE) == pytest.approx(expected, abs=5e-3)


def test_a_change_of_brightness_costs_nothing_and_a_blur_nearly_all() -> None:
    image = noise(3)
    assert explained_detail(image + 0.1, image, WHOLE) == pytest.approx(1.0, abs=1e-6)
    assert explained_detail(gaussian_filter(image, (4, 4, 0)), image, WHOLE) < 0.1


def test_masked_pixels_do_not_matter() -> None:
    image, render = noise(4), 0.5 * noise(4)
    valid = WHOLE.copy()
    valid[10:20, 5:50] = False
    expected = explained_detail(render, image, valid)
    for picture in (image, render):
        picture[~valid] = noise(5)[~valid]
    assert explained_detail(render, image, valid) == pytest.approx(expected, abs=1e-6)


def test_means_without_what_moves_are_given_if_it_was_masked() -> None:
    plain = [FrameScore(i, f"{i}", True, "online", 20.0, 0.9, None) for i in range(2)]
    masked = [
        replace(plain[0], still=StillScore(30.0, 0.98, 0.1)),
        replace(plain[1], still=StillScore(32.0, 0.96, 0.0)),
    ]
    assert not {"psnr_still", "ssim_still", "moving"} & set(summary(plain))
    means = summary(masked)
    assert {name: means[name] for name in summary(plain)} == summary(plain)
    assert (means["psnr_still"], means["ssim_still"], means["moving"]) == (31.0, 0.97, 0.05)
    json.dumps(means)


@pytest.mark.slow
@pytest.mark.usefixtures("taichi_on_the_cpu")
def test_a_frame_is_rendered_once_and_scored_with_and_without_what_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    initialise("cpu")
    mapper = OnlineMapper(MappingSettings(**WALKED, transients=True), 64, 48, seed=1)
    frames = [walked(i) for i in range(FRAMES)]
    for frame in frames:
        if frame.index % 4 != 2:
            mapper.process(frame)
    mapper.finish()
    poses = [mapper.keyframes.corrected(frame.index, frame.T_camera_world) for frame in frames]
    version = MapVersion(mapper.gaussians.to_numpy(), poses, [None] * FRAMES, 0)
    held_out = frames[2::4]
    plain = [score_frame(mapper, frame, poses[frame.index], "online")[0] for frame in held_out]
    of_the_wall = [score_frame(mapper, still(frame.index), poses[frame.index], "online")[0] for frame in held_out]

    renders, forward = [], mapper.renderer.forward
    monkeypatch.setattr(mapper.renderer, "forward", lambda *view: (renders.append(1), forward(*view)))
    scores = evaluate(mapper, held_out, {"online": version}, None, lambda *_: None)
    assert len(renders) == len(held_out) + len(mapper.keyframes.selected)
    assert [replace(score, still=None) for score in scores] == plain
    for score, wall, frame in zip(scores, of_the_wall, held_out, strict=True):
        assert score.still is not None
        if walker(frame.index).any():
            assert score.still.moving > 0.8 * walker(frame.index).mean()
            assert abs(score.still.psnr - wall.psnr) < 0.3 * (wall.psnr - score.psnr)
        else:
            assert (score.still.psnr, score.still.moving) == (score.psnr, 0.0)

"""Scores of frames against independent implementations."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from fields.runtime.backend import initialise
from modp_ti.files.errors import InputError
from modp_ti.outputs import lpips as module
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
from modp_ti.outputs.lpips import MIN_SIDE, Lpips, open_lpips
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


Entries = dict[str, torch.Tensor]


@pytest.fixture(scope="module")
def made(lpips_weights: Path) -> tuple[Entries, Entries]:
    """AlexNet's entries and those of the linear layers."""
    return torch.load(lpips_weights / "alexnet-owt-7be5be79.pth"), torch.load(lpips_weights / "alex.pth")


@pytest.fixture(scope="module")
def lpips(lpips_weights: Path) -> Lpips:
    return Lpips(lpips_weights / "alexnet-owt-7be5be79.pth", lpips_weights / "alex.pth")


def pictures(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    a = rng.random((height, width, 3), dtype=np.float32)
    return a, np.clip(a + rng.normal(0, 0.2, a.shape), 0, 1).astype(np.float32)


def plain_features(alexnet: Entries, picture: np.ndarray) -> list[np.ndarray]:
    """Channels (C, h, w) of the five layers."""
    from scipy.signal import correlate  # takes seconds, which the collection of the tests would wait for

    x = picture.astype(np.float64).transpose(2, 0, 1) * 2 - 1
    x = (x - np.array([-0.030, -0.088, -0.188])[:, None, None]) / np.array([0.458, 0.448, 0.450])[:, None, None]
    features = []
    for i, stride, padding in ((0, 4, 2), (3, 1, 2), (6, 1, 1), (8, 1, 1), (10, 1, 1)):
        if i in (3, 6):
            windows = np.lib.stride_tricks.sliding_window_view(x, (3, 3), axis=(1, 2))
            x = windows[:, ::2, ::2].max(axis=(-1, -2))
        x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
        kernels, bias = alexnet[f"features.{i}.weight"].double().numpy(), alexnet[f"features.{i}.bias"].numpy()
        x = np.stack([correlate(x, k, mode="valid")[0, ::stride, ::stride] for k in kernels]) + bias[:, None, None]
        x = np.maximum(x, 0)
        features.append(x)
    return features


def test_the_distance_is_that_of_the_formula(lpips: Lpips, made: tuple[Entries, Entries]) -> None:
    a, b = pictures(37, 45)
    expected = 0.0
    layers = zip(plain_features(made[0], a), plain_features(made[0], b), made[1].values(), strict=True)
    for x, y, weight in layers:
        difference = x / np.linalg.norm(x, axis=0) - y / np.linalg.norm(y, axis=0)
        expected += np.einsum("chw,c->hw", difference**2, weight.numpy().ravel()).mean()
    assert expected > 0.1
    assert lpips(a, b) == pytest.approx(expected, rel=1e-4)
    assert lpips(b, a) == pytest.approx(expected, rel=1e-4)


def test_a_picture_is_no_distance_from_itself_and_one_without_features_is_finite(lpips: Lpips) -> None:
    a, b = pictures(MIN_SIDE, 50)
    assert lpips(a, a) == 0.0
    assert lpips(a, a) < lpips(a, 0.9 * a + 0.1 * b) < lpips(a, b)
    assert np.isfinite(lpips(np.zeros((40, 40, 3), np.float32), np.ones((40, 40, 3), np.float32)))


def test_weights_are_found_in_torch_s_cache_and_the_package_or_a_reason_is_given(
    lpips_weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "nowhere"))
    monkeypatch.setattr(module, "_package", list)
    found, reason = open_lpips(None, 100)
    assert found is None and "evaluation.lpips_weights" in reason and "\n" not in reason
    cache = tmp_path / "nowhere" / "hub" / "checkpoints"
    cache.mkdir(parents=True)
    (cache / "alexnet-owt-7be5be79.pth").symlink_to(lpips_weights / "alexnet-owt-7be5be79.pth")
    assert "alex.pth" in open_lpips(None, 100)[1]
    monkeypatch.setattr(module, "_package", lambda: [lpips_weights])
    found, reason = open_lpips(None, 100)
    assert found is not None and reason is None
    assert str(MIN_SIDE) in open_lpips(lpips_weights, MIN_SIDE - 1)[1]


def test_a_folder_without_them_or_with_others_is_an_error(
    made: tuple[Entries, Entries], lpips_weights: Path, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"alexnet-owt-7be5be79\.pth"):
        open_lpips(tmp_path, 100)
    (tmp_path / "alexnet-owt-7be5be79.pth").symlink_to(lpips_weights / "alexnet-owt-7be5be79.pth")
    for change in ({"lin2.model.1.weight": torch.zeros(1, 256, 1, 1)}, {"lin5.model.1.weight": torch.zeros(1)}):
        torch.save({**made[1], **change}, tmp_path / "alex.pth")
        with pytest.raises(InputError, match=next(iter(change))):
            open_lpips(tmp_path, 100)

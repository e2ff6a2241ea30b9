"""LPIPS against its formula in plain NumPy, on made weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from modp_ti.files.errors import InputError
from modp_ti.outputs import lpips as module
from modp_ti.outputs.lpips import MIN_SIDE, Lpips, open_lpips

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

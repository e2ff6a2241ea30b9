"""A checkpoint of DepthCov loads where every entry is as published, and the wrong entry is named where not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from pipelines.densify.depth import load_depthcov

Entries = dict[str, torch.Tensor]


def test_the_made_checkpoint_is_as_large_as_the_published_one(published: Entries) -> None:
    network = [value for name, value in published.items() if name.startswith("gaussian_cov_net.")]
    assert len(published) == 122
    assert len(network) == 106
    assert sum(value.numel() for value in network) == 9_003_020


def test_every_weight_comes_to_its_place(checkpoint: Path, published: Entries) -> None:
    weights = load_depthcov(checkpoint)
    loaded = weights.network.state_dict()
    assert len(loaded) == 106
    for name, value in loaded.items():
        torch.testing.assert_close(value, published[f"gaussian_cov_net.{name}"], rtol=0, atol=0)
    assert weights.log_scale == pytest.approx(-1.25)  # of the finest level, index 3
    assert weights.log_noise == pytest.approx(-2.5)


def damaged(name: str, value: torch.Tensor | None) -> Callable[[Entries], Entries]:
    def change(entries: Entries) -> Entries:
        entries = {**entries, name: value}
        return {key: v for key, v in entries.items() if v is not None}

    return change


WEIGHT = "gaussian_cov_net.up_convs.3.conv_block.conv2.weight"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (damaged(WEIGHT, None), f"entry `{WEIGHT}` is missing"),
        (damaged(WEIGHT, torch.zeros(128, 256, 3, 3)), rf"`{WEIGHT}` has shape \(128, 256, 3, 3\).*\(128, 128, 3, 3\)"),
        (damaged(WEIGHT, torch.full((128, 128, 3, 3), torch.nan)), f"entry `{WEIGHT}` holds NaN"),
        (damaged("gaussian_cov_net.extra.bias", torch.zeros(3)), "entry `gaussian_cov_net.extra.bias` is unexpected"),
        (damaged("log_depth_var_scales.2", None), "entry `log_depth_var_scales.2` is missing"),
        (damaged("log_depth_var_scales.2", torch.zeros(2)), r"`log_depth_var_scales.2` has shape \(2,\)"),
        (damaged("cross_cov_modules.1.scale_param", torch.tensor(0.5)), "`cross_cov_modules.1.scale_param` is 0.5"),
    ],
)
def test_damage_is_refused_with_the_entry_s_name(
    published: Entries, tmp_path: Path, change: Callable[[Entries], Entries], said: str
) -> None:
    path = tmp_path / "damaged.ckpt"
    torch.save({"state_dict": change(published)}, path)
    with pytest.raises(ValueError, match=said) as caught:
        load_depthcov(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_numbers_may_be_written_with_an_axis(published: Entries, tmp_path: Path) -> None:
    scalars = {name: value[None] if value.ndim == 0 else value for name, value in published.items()}
    torch.save({"state_dict": scalars}, tmp_path / "axis.ckpt")
    assert load_depthcov(tmp_path / "axis.ckpt").log_scale == pytest.approx(-1.25)

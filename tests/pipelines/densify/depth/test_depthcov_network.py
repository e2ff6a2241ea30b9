"""The network of DepthCov against its description in plain operations, straight from the checkpoint's entries."""

from __future__ import annotations

from pathlib import Path

import torch
from torch.nn import functional

from pipelines.densify.depth import load_depthcov
from pipelines.densify.depth.depthcov import pixel_covariances

Entries = dict[str, torch.Tensor]


def group_norm(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
    _, c, h, w = x.shape
    groups = x.reshape(16, c // 16 * h * w)
    groups = (groups - groups.mean(1, keepdim=True)) / (groups.var(1, unbiased=False, keepdim=True) + 1e-5).sqrt()
    return groups.reshape(x.shape) * weight[:, None, None] + bias[:, None, None]


def leaky(x: torch.Tensor) -> torch.Tensor:
    return torch.where(x > 0, x, 0.01 * x)


def block(net: Entries, name: str, x: torch.Tensor) -> torch.Tensor:
    def conv(which: str, x: torch.Tensor, padding: int) -> torch.Tensor:
        return functional.conv2d(x, net[f"{name}.{which}.weight"], net[f"{name}.{which}.bias"], padding=padding)

    norm = net[f"{name}.norm.weight"], net[f"{name}.norm.bias"]
    y = leaky(group_norm(conv("conv1", x, 1), *norm))
    y = group_norm(conv("conv2", y, 1), *norm)
    return leaky(conv("conv3", x, 0) + y)


def twice(x: torch.Tensor, dim: int) -> torch.Tensor:
    """Bilinear doubling along one axis: the new pixels lie a quarter pixel beside the old ones."""
    n = x.shape[dim]
    before = torch.cat([x.narrow(dim, 0, 1), x.narrow(dim, 0, n - 1)], dim)
    after = torch.cat([x.narrow(dim, 1, n - 1), x.narrow(dim, n - 1, 1)], dim)
    return torch.stack([0.75 * x + 0.25 * before, 0.75 * x + 0.25 * after], dim + 1).flatten(dim, dim + 1)


def plain_network(published: Entries, image: torch.Tensor) -> torch.Tensor:
    net = {name.removeprefix("gaussian_cov_net."): value.double() for name, value in published.items()}
    mean, std = torch.tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]], dtype=torch.float64)[..., None, None]
    levels = [block(net, "base", (image.double() - mean) / std)]
    for i in range(5):
        x = levels[-1]
        x = x.unfold(2, 2, 2).unfold(3, 2, 2).amax((-1, -2))
        levels.append(block(net, f"down_convs.{i}.conv_block", x))
    x = levels.pop()
    for i in (4, 3, 2, 1, 0):
        x = twice(twice(x, 2), 3)
        x = functional.conv2d(
            x, net[f"up_convs.{i}.upsample.1.weight"], net[f"up_convs.{i}.upsample.1.bias"], padding=1
        )
        x = block(net, f"up_convs.{i}.conv_block", torch.cat([x, levels[i]], 1))
    return functional.conv2d(x, net["feature_convs.0.weight"], net["feature_convs.0.bias"])


def test_the_network_is_the_one_described(checkpoint: Path, published: Entries) -> None:
    image = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        raw = load_depthcov(checkpoint).network(image)
    expected = plain_network(published, image)
    assert raw.shape == (1, 3, 64, 96)
    assert expected.std(dim=(2, 3)).min() > 0.1  # it says something of the image
    torch.testing.assert_close(raw.double(), expected, rtol=1e-3, atol=1e-3)


def test_covariances_are_positive_definite_and_within_their_bounds() -> None:
    raw = torch.tensor([[-50.0, 50.0, 0.0, 3.0, -50.0], [-50.0, -50.0, 1.0, 3.0, -50.0], [0.0, 9.0, 0.5, -9.0, 9.0]])
    rr, rc, cc = pixel_covariances(raw[None, :, None])[0, :, 0]
    torch.testing.assert_close(rr, torch.tensor([1e-3, 1e4, 1.0, 3.0, 1e-3]).where(raw[0] != 3, raw[0].exp()))
    torch.testing.assert_close(cc, torch.tensor([1e-3, 1e-3, 1.0, 3.0, 1e-3]).where(raw[1].abs() > 5, raw[1].exp()))
    correlation = rc / torch.sqrt(rr * cc - 1e-8)
    torch.testing.assert_close(correlation, 0.99 * torch.tanh(raw[2]))
    assert (rr * cc - rc**2 > 0).all()

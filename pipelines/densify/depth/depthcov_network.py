"""The network of DepthCov, which predicts the covariance parameters at each pixel of an image."""

from __future__ import annotations

import math

import torch
from torch import nn

__all__ = ["DepthCovNetwork", "pixel_covariances"]

LEVELS = 5
# Image sides must be multiples of this, since each level halves the size.
STRIDE = 2**LEVELS
FEATURE_LEVELS = 4
BASE_CHANNELS = 16
GROUPS = 16
SLOPE = 0.01

MIN_VARIANCE, MAX_VARIANCE = 1e-3, 1e4
MAX_CORRELATION = 0.99


class DepthCovNetwork(nn.Module):
    """U-Net of residual blocks with 106 tensors and 9,003,020 parameters, named as in the published state dict.

    Takes RGB images (B, 3, H, W) in [0, 1] with sides that are multiples of 32. Returns the three raw outputs
    (B, 3, H, W) of the finest level, which the paper uses. The outputs of the other levels have weights but are not
    computed.
    """

    mean: torch.Tensor
    std: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1), persistent=False)
        channels = [BASE_CHANNELS * 2**i for i in range(LEVELS)]
        self.base = ResidualBlock(3, BASE_CHANNELS)
        self.down_convs = nn.ModuleList(Down(c) for c in channels)
        self.up_convs = nn.ModuleList(Up(c) for c in channels)
        self.feature_convs = nn.ModuleList(nn.Conv2d(c, 3, 1) for c in channels[:FEATURE_LEVELS])

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        x = self.base((image - self.mean) / self.std)
        skips = []
        for down in self.down_convs:
            skips.append(x)
            x = down(x)
        for up in reversed(self.up_convs):
            x = up(x, skips.pop())
        return self.feature_convs[0](x)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with a 1x1 convolution as the shortcut. Both 3x3 convolutions share one normalisation."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels_out, 3, padding=1)
        self.conv2 = nn.Conv2d(channels_out, channels_out, 3, padding=1)
        self.conv3 = nn.Conv2d(channels_in, channels_out, 1)
        self.norm = nn.GroupNorm(GROUPS, channels_out)
        self.activation = nn.LeakyReLU(SLOPE)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = self.activation(self.norm(self.conv1(x)))
        y = self.norm(self.conv2(y))
        return self.activation(self.conv3(x) + y)


class Down(nn.Module):
    """Halves the size and doubles the number of channels from `channels`."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.pool = nn.MaxPool2d(2)
        self.conv_block = ResidualBlock(channels, 2 * channels)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.conv_block(self.pool(x))


class Up(nn.Module):
    """Doubles the size and halves the number of channels to `channels`, with a skip connection."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.upsample = nn.Sequential(
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False),
            nn.Conv2d(2 * channels, channels, 3, padding=1),
        )
        self.conv_block = ResidualBlock(2 * channels, channels)

    def forward(self, x: torch.Tensor, skip: torch.Tensor) -> torch.Tensor:
        return self.conv_block(torch.cat([self.upsample(x), skip], dim=1))


def pixel_covariances(raw: torch.Tensor) -> torch.Tensor:
    """Convert the network's outputs to covariances over (row, column).

    With the outputs (a, b, c): rr = exp(a) and cc = exp(b), each clamped to [1e-3, 1e4], and
    rc = 0.99 tanh(c) sqrt(rr cc - 1e-8).

    Args:
        raw: Outputs of the network (B, 3, H, W).

    Returns:
        Covariances (B, 3, H, W) as (rr, rc, cc).
    """
    low, high = math.log(MIN_VARIANCE), math.log(MAX_VARIANCE)
    rr = torch.exp(raw[:, 0].clamp(low, high))
    cc = torch.exp(raw[:, 1].clamp(low, high))
    rc = MAX_CORRELATION * torch.tanh(raw[:, 2]) * torch.sqrt(rr * cc - 1e-8)
    return torch.stack([rr, rc, cc], dim=1)

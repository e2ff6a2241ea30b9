"""The network of DepthCov, which predicts the covariance parameters at each pixel of an image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional

from fields.map.keyframe import Keyframe
from pipelines.densify.depth.estimate import DepthEstimate, unknown_depth
from pipelines.densify.depth.gaussian_process import (
    MIN_POINTS,
    conditioning_points,
    nonstationary_matern32,
    nonstationary_variance,
    regress_log_depth,
)
from pipelines.settings import DepthSettings
from pipelines.torch_checkpoint import read_checkpoint, require_entries

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
    """Convert the network's outputs (B, 3, H, W) to covariances (B, 3, H, W) over (row, column), as (rr, rc, cc).

    With the outputs (a, b, c): rr = exp(a) and cc = exp(b), each clamped to [1e-3, 1e4], and
    rc = 0.99 tanh(c) sqrt(rr cc - 1e-8).
    """
    low, high = math.log(MIN_VARIANCE), math.log(MAX_VARIANCE)
    rr = torch.exp(raw[:, 0].clamp(low, high))
    cc = torch.exp(raw[:, 1].clamp(low, high))
    rc = MAX_CORRELATION * torch.tanh(raw[:, 2]) * torch.sqrt(rr * cc - 1e-8)
    return torch.stack([rr, rc, cc], dim=1)


NETWORK = "gaussian_cov_net."
SCALE_COPIES = ("cov_modules", "cross_cov_modules", "diagonal_cov_modules")
FINEST = FEATURE_LEVELS - 1


@dataclass(frozen=True)
class DepthCovWeights:
    """Weights of DepthCov.

    Attributes:
        network: Network with its weights.
        log_scale: Logarithm of the scale of the process at the finest level.
        log_noise: Logarithm of the noise of the process at the finest level.
    """

    network: DepthCovNetwork
    log_scale: float
    log_noise: float


def load_depthcov(path: Path) -> DepthCovWeights:
    """Read a checkpoint with the published 122 entries under `state_dict`, without running pickled code.

    Raises:
        ValueError: If an entry is missing, unexpected or of another shape (the message names it), or if the three
            copies of a level's scale disagree. The message is one line.
    """
    entries = read_checkpoint(path, "state_dict")
    network = DepthCovNetwork()
    shapes = {NETWORK + name: value.shape for name, value in network.state_dict().items()}
    for level in range(FEATURE_LEVELS):
        for name in (_noise(level), *_scales(level)):
            shapes[name] = ()
            # A scalar may be stored with shape () or (1,).
            if name in entries and entries[name].shape == (1,):
                entries[name] = entries[name][0]
    require_entries(path, entries, shapes)
    for level in range(FEATURE_LEVELS):
        first, *copies = _scales(level)
        for copy in copies:
            if entries[copy] != entries[first]:
                raise ValueError(
                    f"{path}: entry `{copy}` is {float(entries[copy])}, `{first}` is {float(entries[first])}: "
                    "they must agree"
                )
    network.load_state_dict({name.removeprefix(NETWORK): v for name, v in entries.items() if name.startswith(NETWORK)})
    network.requires_grad_(False).eval()
    # The channels-last layout is a quarter faster on a CPU.
    network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]  # torch's overloads lack it
    return DepthCovWeights(network, float(entries[_scales(FINEST)[0]]), float(entries[_noise(FINEST)]))


def _noise(level: int) -> str:
    return f"log_depth_var_scales.{level}"


def _scales(level: int) -> list[str]:
    return [f"{copy}.{level}.scale_param" for copy in SCALE_COPIES]


BASE_NOISE = 1e-2


class DepthCov:
    """The paper's depth estimator for high-error pixels (Section 3.2.2).

    The network runs once per call on the whole image, resized to the nearest multiples of 32. The process is defined in
    coordinates from -1 to 1 along each side, which resizing preserves and padding would not. Noise and scale are those
    of the published weights, so that deviations are comparable with the paper's.

    Args:
        settings: Settings of the depth estimation.
        weights: Result of `load_depthcov`.
        rng: Random generator that selects the conditioning points.
    """

    def __init__(self, settings: DepthSettings, weights: DepthCovWeights, rng: np.random.Generator) -> None:
        self.settings = settings
        self._network = weights.network
        self._scale = math.exp(weights.log_scale)
        self._noise = BASE_NOISE * math.exp(weights.log_noise)
        self._rng = rng

    def estimate(self, view: Keyframe, neighbours: Sequence[Keyframe], pixels: NDArray[np.float64]) -> DepthEstimate:
        """See `DepthEstimator`. With fewer than `MIN_POINTS` tracked points, all depths are unknown."""
        places, z = conditioning_points(view, self.settings.max_points, self._rng)
        if len(z) < MIN_POINTS or len(pixels) == 0:
            return unknown_depth(len(pixels))
        covariances = self.covariances(view.rgba)
        size = np.array([view.camera.width, view.camera.height])
        known, asked = (torch.from_numpy(2.0 * p / size - 1.0).flip(1) for p in (places, np.asarray(pixels)))
        E_known, E_asked = _sampled(covariances, known), _sampled(covariances, asked)
        K = self._scale * nonstationary_matern32(known, E_known, known, E_known)
        k = self._scale * nonstationary_matern32(asked, E_asked, known, E_known)
        return regress_log_depth(z, K, self._noise, k, self._scale * nonstationary_variance(E_asked))

    @torch.inference_mode()
    def covariances(self, rgba: NDArray[np.uint8]) -> torch.Tensor:
        """Run the network on an image (H, W, 4).

        Returns:
            Covariances (1, 3, h, w) over (row, column) in [-1, 1]^2, with h and w multiples of 32.
        """
        image = torch.from_numpy(rgba[..., :3] / np.float32(255.0)).permute(2, 0, 1)[None]
        size = [max(round(side / STRIDE), 1) * STRIDE for side in image.shape[2:]]
        image = functional.interpolate(image, size, mode="bilinear", align_corners=False)
        return pixel_covariances(self._network(image.contiguous(memory_format=torch.channels_last)))


def _sampled(covariances: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Covariances (N, 3) float64 at points (N, 2) as (row, column) in [-1, 1]: bilinear, reflected at the border."""
    grid = places.flip(1)[None, None].to(covariances.dtype)  # (x, y)
    sampled = functional.grid_sample(covariances, grid, mode="bilinear", padding_mode="reflection", align_corners=False)
    return sampled[0, :, 0].T.double()

"""Reading of the published DepthCov checkpoint, which the user provides. All names and shapes are checked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from pipelines.densify.depth.depthcov_network import FEATURE_LEVELS, DepthCovNetwork
from pipelines.torch_checkpoint import read_checkpoint, require_entries

__all__ = ["DepthCovWeights", "load_depthcov"]

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

    Args:
        path: The checkpoint.

    Returns:
        The weights.

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

"""A DepthCov checkpoint with the published names and shapes, and weights that nobody has trained."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

LEVELS = range(5)
FEATURES = range(4)
NET = "gaussian_cov_net"


def published_shapes() -> dict[str, tuple[int, ...]]:
    """Name and shape of the 122 entries, written out from the description and not from the code."""
    shapes: dict[str, tuple[int, ...]] = {}

    def conv(name: str, out: int, into: int, side: int) -> None:
        shapes[f"{name}.weight"], shapes[f"{name}.bias"] = (out, into, side, side), (out,)

    def block(name: str, into: int, out: int) -> None:
        conv(f"{name}.conv1", out, into, 3)
        conv(f"{name}.conv2", out, out, 3)
        conv(f"{name}.conv3", out, into, 1)
        shapes[f"{name}.norm.weight"] = shapes[f"{name}.norm.bias"] = (out,)

    block(f"{NET}.base", 3, 16)
    for i in LEVELS:
        c = 16 * 2**i
        block(f"{NET}.down_convs.{i}.conv_block", c, 2 * c)
        conv(f"{NET}.up_convs.{i}.upsample.1", c, 2 * c, 3)
        block(f"{NET}.up_convs.{i}.conv_block", 2 * c, c)
    for i in FEATURES:
        conv(f"{NET}.feature_convs.{i}", 3, 16 * 2**i, 1)
        shapes[f"log_depth_var_scales.{i}"] = ()
        for module in ("cov_modules", "cross_cov_modules", "diagonal_cov_modules"):
            shapes[f"{module}.{i}.scale_param"] = ()
    return shapes


@pytest.fixture(scope="session")
def published() -> dict[str, torch.Tensor]:
    """The entries. Not to be changed."""
    generator = torch.Generator().manual_seed(5)
    entries = {}
    for name, shape in published_shapes().items():
        noise = torch.randn(shape, generator=generator)
        if name.endswith("norm.weight"):
            entries[name] = 1.0 + 0.1 * noise
        elif len(shape) == 4:
            entries[name] = noise * (2.0 / (shape[1] * shape[2] * shape[3])) ** 0.5
        else:
            entries[name] = 0.1 * noise
    for i in FEATURES:
        # Correlation over a good part of the image, in coordinates from -1 to 1.
        entries[f"{NET}.feature_convs.{i}.bias"] = torch.tensor([-2.0, -1.5, 0.2])
        for module in ("cov_modules", "cross_cov_modules", "diagonal_cov_modules"):
            entries[f"{module}.{i}.scale_param"] = torch.tensor(-0.5 - 0.25 * i)
        entries[f"log_depth_var_scales.{i}"] = torch.tensor(-1.0 - 0.5 * i)
    return entries


@pytest.fixture(scope="session")
def checkpoint(published: dict[str, torch.Tensor], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file as Lightning writes it."""
    path = tmp_path_factory.mktemp("depthcov") / "made.ckpt"
    torch.save({"epoch": 3, "global_step": 17, "state_dict": published, "hyper_parameters": {"lr": 1e-4}}, path)
    return path

"""LPIPS (AlexNet, version 0.1) [Zhang 2018], with weights that the user provides."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from modp_ti.files.errors import InputError
from pipelines.torch_checkpoint import read_checkpoint, require_entries

# File names as used by torchvision and the `lpips` package.
ALEXNET = "alexnet-owt-7be5be79.pth"
LINEAR = "alex.pth"

# AlexNet's convolutions by their index in `features`: kernel shape, stride, padding. A max pool precedes those in
# `POOLED`.
CONVOLUTIONS = {
    0: ((64, 3, 11, 11), 4, 2),
    3: ((192, 64, 5, 5), 1, 2),
    6: ((384, 192, 3, 3), 1, 1),
    8: ((256, 384, 3, 3), 1, 1),
    10: ((256, 256, 3, 3), 1, 1),
}
POOLED = (3, 6)
# Smallest image side for which the last pool still has a full window [px].
MIN_SIDE = 31


class Lpips:
    """The LPIPS distance of two images.

    It compares the features of AlexNet's five layers: the sum over layers of the mean over pixels of w . (a / |a| - b /
    |b|)^2, where a and b are the channels of a pixel.
    """

    def __init__(self, alexnet: Path, linear: Path) -> None:
        """Load the weights.

        Args:
            alexnet: AlexNet's weights in torchvision's format.
            linear: Weights w of the five linear layers.

        Raises:
            ValueError: If an entry of a file is missing or has the wrong shape.
        """
        entries = read_checkpoint(alexnet)
        features = {name: entry for name, entry in entries.items() if not name.startswith("classifier.")}
        shapes: dict[str, tuple[int, ...]] = {}
        for i, (shape, _, _) in CONVOLUTIONS.items():
            shapes[f"features.{i}.weight"], shapes[f"features.{i}.bias"] = shape, shape[:1]
        require_entries(alexnet, features, shapes)
        weights = read_checkpoint(linear)
        names = [f"lin{i}.model.1.weight" for i in range(len(CONVOLUTIONS))]
        channels = [shape[0] for shape, _, _ in CONVOLUTIONS.values()]
        require_entries(linear, weights, {name: (1, c, 1, 1) for name, c in zip(names, channels, strict=True)})
        self._features = features
        self._linear = [weights[name] for name in names]
        self._shift = torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
        self._scale = torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)

    @torch.inference_mode()
    def __call__(self, a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
        """Return the LPIPS of two images (H, W, 3), RGB in [0, 1], with sides of at least MIN_SIDE pixels."""
        both = torch.from_numpy(np.stack([a, b]).astype(np.float32)).permute(0, 3, 1, 2)
        x = (2.0 * both - 1.0 - self._shift) / self._scale
        total = 0.0
        for (i, (_, stride, padding)), weight in zip(CONVOLUTIONS.items(), self._linear, strict=True):
            if i in POOLED:
                x = functional.max_pool2d(x, 3, 2)
            kernel, bias = self._features[f"features.{i}.weight"], self._features[f"features.{i}.bias"]
            x = functional.relu(functional.conv2d(x, kernel, bias, stride, padding))
            unit = x / (x.norm(dim=1, keepdim=True) + 1e-10)
            total += float(functional.conv2d((unit[:1] - unit[1:]) ** 2, weight).mean())
        return total


def open_lpips(folder: Path | None, side: int) -> tuple[Lpips | None, str | None]:
    """Load LPIPS if its weights are on this machine. Nothing is downloaded.

    Args:
        folder: Folder with the two weight files. None looks in torchvision's download folder and in the installed
            `lpips` package.
        side: Shorter side of the images [px].

    Returns:
        The network and None, or None and a one-line reason why it is not available.

    Raises:
        InputError: If `folder` is given and a file in it is missing or invalid.
    """
    if side < MIN_SIDE:
        return None, f"LPIPS is not computed: it needs sides of at least {MIN_SIDE} pixels, here one has {side}"
    places = [folder] if folder is not None else [Path(torch.hub.get_dir()) / "checkpoints"]
    alexnet = _first(places, ALEXNET)
    linear = _first([*places, *_package()], LINEAR)
    try:
        if alexnet is None or linear is None:
            missing = [name for name, file in ((ALEXNET, alexnet), (LINEAR, linear)) if file is None]
            raise ValueError(f"no {' and no '.join(missing)} in {places[0]}")
        return Lpips(alexnet, linear), None
    except ValueError as error:
        if folder is not None:
            raise InputError(f"evaluation.lpips_weights: {error}") from None
        return None, f"LPIPS is not computed: {error} (see evaluation.lpips_weights)"


def _first(places: Iterable[Path], name: str) -> Path | None:
    return next((place / name for place in places if (place / name).is_file()), None)


def _package() -> list[Path]:
    """Return the weight folder of the `lpips` package, which ships the linear layers, without importing it."""
    spec = importlib.util.find_spec("lpips")
    return [Path(p) / "weights" / "v0.1" for p in (spec.submodule_search_locations or [])] if spec else []

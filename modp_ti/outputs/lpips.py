"""LPIPS, the learned distance of two pictures (AlexNet, version 0.1) [Zhang 2018], from weights that the user has."""

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

__all__ = ["MIN_SIDE", "Lpips", "open_lpips"]

# The files as torchvision and the `lpips` package name them.
ALEXNET = "alexnet-owt-7be5be79.pth"
LINEAR = "alex.pth"

# Convolutions of AlexNet's `features` by index: shape of the kernel, stride, padding; a pool comes before `POOLED`.
CONVOLUTIONS = {
    0: ((64, 3, 11, 11), 4, 2),
    3: ((192, 64, 5, 5), 1, 2),
    6: ((384, 192, 3, 3), 1, 1),
    8: ((256, 384, 3, 3), 1, 1),
    10: ((256, 256, 3, 3), 1, 1),
}
POOLED = (3, 6)
# The least side whose last pool still has a full window.
MIN_SIDE = 31


class Lpips:
    """Distance of two pictures: the features of AlexNet's five layers, compared pixel by pixel.

    sum over layers of the mean over pixels of w . (a / |a| - b / |b|)^2, with a and b the channels of a pixel.
    """

    def __init__(self, alexnet: Path, linear: Path) -> None:
        """Read the weights of AlexNet (torchvision) and of the five linear layers. ValueError names a wrong entry."""
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
        """LPIPS of two pictures (H, W, 3), RGB in [0, 1], with sides of at least MIN_SIDE pixels."""
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
    """LPIPS and None, or None and the reason, in one line, why there is none. Nothing is downloaded.

    folder: where the two files are; None looks where torchvision keeps its downloads and where the `lpips` package
    is installed. side: the smaller one of the pictures [pixels]. Raises InputError where a folder is given and a file
    in it is missing or is not what it should be.
    """
    if side < MIN_SIDE:
        return None, f"LPIPS is not computed: it needs sides of at least {MIN_SIDE} pixels, here one has {side}"
    places = [folder] if folder is not None else [Path(torch.hub.get_dir()) / "checkpoints"]
    alexnet = _first(places, ALEXNET)
    linear = _first([*places, *_package()], LINEAR)
    missing = [name for name, file in ((ALEXNET, alexnet), (LINEAR, linear)) if file is None]
    try:
        if missing:
            raise ValueError(f"no {' and no '.join(missing)} in {places[0]}")
        return Lpips(alexnet, linear), None
    except ValueError as error:
        if folder is not None:
            raise InputError(f"evaluation.lpips_weights: {error}") from None
        return None, f"LPIPS is not computed: {error} (see evaluation.lpips_weights)"


def _first(places: Iterable[Path], name: str) -> Path | None:
    return next((place / name for place in places if (place / name).is_file()), None)


def _package() -> list[Path]:
    """Where the `lpips` package, which brings the linear layers, keeps them; it is not imported."""
    spec = importlib.util.find_spec("lpips")
    return [Path(p) / "weights" / "v0.1" for p in (spec.submodule_search_locations or [])] if spec else []

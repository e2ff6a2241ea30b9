"""Files of trained weights: tensors by name, read without running what is pickled in them, every entry checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

__all__ = ["read_weights", "require_entries"]


def read_weights(path: Path, key: str | None = None) -> dict[str, torch.Tensor]:
    """The tensors of a file that `torch.save` wrote, on the CPU as float32; of its entry `key` where one is given.

    Raises ValueError (one line) where the file is none, holds code, or holds anything but finite tensors by name.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the unpickler and the archive reader have no common one
        reason = str(error).strip().splitlines()
        raise ValueError(
            f"{path}: cannot be loaded as weights only ({reason[0] if reason else type(error).__name__})"
        ) from None
    if key is not None:
        if not isinstance(content, Mapping) or key not in content:
            raise ValueError(f"{path}: has no entry `{key}`")
        content = content[key]
    if not isinstance(content, Mapping):
        raise ValueError(f"{path}: holds {type(content).__name__}, not tensors by name")
    for name, value in content.items():
        if not isinstance(value, torch.Tensor):
            raise ValueError(f"{path}: entry `{name}` is {type(value).__name__}, not a tensor")
        if not torch.isfinite(value).all():
            raise ValueError(f"{path}: entry `{name}` holds NaN or infinite values")
    return {str(name): value.detach().to(torch.float32) for name, value in content.items()}


def require_entries(path: Path, entries: Mapping[str, torch.Tensor], shapes: Mapping[str, Sequence[int]]) -> None:
    """Raise ValueError naming the first entry of `entries` that is missing, has another shape, or is unexpected."""
    for name, shape in shapes.items():
        if name not in entries:
            raise ValueError(f"{path}: entry `{name}` is missing")
        if tuple(entries[name].shape) != tuple(shape):
            raise ValueError(
                f"{path}: entry `{name}` has shape {tuple(entries[name].shape)}, it must have {tuple(shape)}"
            )
    for name in entries:
        if name not in shapes:
            raise ValueError(f"{path}: entry `{name}` is unexpected")

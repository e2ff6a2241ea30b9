"""Safe reading of trained weights: no pickled code is run, and every entry is checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch


def read_checkpoint(path: Path, key: str | None = None) -> dict[str, torch.Tensor]:
    """Read the tensors of a file written by `torch.save`.

    Args:
        path: The file.
        key: Entry that holds the tensors; None if the file itself is a dictionary of tensors.

    Returns:
        Tensors by name, on the CPU as float32.

    Raises:
        ValueError: If the file does not exist, contains code, or contains anything but finite tensors by name. The
            message is one line.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the unpickler and the archive reader have no common base class
        reason = [*str(error).strip().splitlines(), type(error).__name__][0]
        raise ValueError(f"{path}: cannot be loaded as weights only ({reason})") from None
    if key is not None:
        if not isinstance(content, Mapping) or key not in content:
            raise ValueError(f"{path}: has no entry `{key}`")
        content = content[key]
    if not isinstance(content, Mapping):
        raise ValueError(f"{path}: holds {type(content).__name__}, not tensors by name")
    for name, value in content.items():
        if not isinstance(value, torch.Tensor) or value.layout is not torch.strided or value.is_quantized:
            raise ValueError(f"{path}: entry `{name}` is {type(value).__name__}, not a plain tensor")
        if not torch.isfinite(value).all():
            raise ValueError(f"{path}: entry `{name}` holds NaN or infinite values")
    return {str(name): value.detach().to(torch.float32) for name, value in content.items()}


def require_entries(path: Path, entries: Mapping[str, torch.Tensor], shapes: Mapping[str, Sequence[int]]) -> None:
    """Raise ValueError, which names the file and the first entry, if one is missing, unexpected or of another shape."""
    for name, shape in shapes.items():
        if name not in entries:
            raise ValueError(f"{path}: entry `{name}` is missing")
        if tuple(entries[name].shape) != tuple(shape):
            raise ValueError(
                f"{path}: entry `{name}` has shape {tuple(entries[name].shape)}, it must have {tuple(shape)}"
            )
    if unexpected := [name for name in entries if name not in shapes]:
        raise ValueError(f"{path}: entry `{unexpected[0]}` is unexpected")

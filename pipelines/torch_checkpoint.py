"""Safe reading of trained weights: no pickled code is run, and every entry is checked."""

from __future__ import annotations

import mmap
import pickletools
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

# Files from before PyTorch 1.6 are consecutive pickles: this number, then version, system information and content.
MAGIC = 0x1950A86A20F9469CFC6C
PICKLES = 4
# Integers up to this occur in every such file: the version is 1001.
SMALL = 4096


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
    _require_bounded(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the unpickler and the archive reader have no common base class
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
        # A strided view can repeat its storage up to any size, and a meta tensor has no storage.
        plain = value.layout is torch.strided and value.device.type == "cpu" and not value.is_quantized
        if not plain or value.numel() * value.element_size() > path.stat().st_size:
            raise ValueError(f"{path}: entry `{name}` is no plain tensor that the file has room for")
        if not torch.isfinite(value).all():
            raise ValueError(f"{path}: entry `{name}` holds NaN or infinite values")
    return {str(name): value.detach().to(torch.float32) for name, value in content.items()}


def _require_bounded(path: Path) -> None:
    """Raise ValueError if loading would allocate more than the size of the file, without loading it."""
    size = path.stat().st_size
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                entries = archive.infolist()
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
                raise ValueError("it is a compressed archive, which weights are not")
            if sum(entry.file_size for entry in entries) > size:
                raise ValueError("it announces more than is in the file")
            return
        if size == 0:
            raise ValueError("it is empty")
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            for _ in range(PICKLES):
                # `genops` parses the pickle without running it. Of a file it needs `read`, `readline` and `tell` only.
                for _, argument, _ in pickletools.genops(content):  # pyright: ignore[reportArgumentType]
                    if isinstance(argument, int) and argument > max(size, SMALL) and argument != MAGIC:
                        raise ValueError("it announces more than is in the file")
    except (ValueError, OSError, IndexError, OverflowError, zipfile.BadZipFile, NotImplementedError) as error:
        reason = str(error).strip().splitlines()
        raise ValueError(
            f"{path}: cannot be loaded as weights only ({reason[0] if reason else type(error).__name__})"
        ) from None


def require_entries(path: Path, entries: Mapping[str, torch.Tensor], shapes: Mapping[str, Sequence[int]]) -> None:
    """Check the names and shapes of all entries.

    Args:
        path: The file, for the error message.
        entries: Tensors by name.
        shapes: Expected shapes by name.

    Raises:
        ValueError: Names the first entry that is missing, has another shape, or is unexpected.
    """
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

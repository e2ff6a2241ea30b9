"""Atomic file writes: a file appears complete or not at all, even after a crash or a power cut."""

from __future__ import annotations

import contextlib
import os
import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray


@contextmanager
def replacing(path: str | os.PathLike[str], mode: str = "wb", sync: bool = True) -> Iterator[IO]:
    """Open a temporary file next to `path` that replaces `path` when the block ends.

    If the block or the write fails, the temporary file is deleted and `path` keeps its old content. The temporary file
    is new, so that no symbolic link is followed and no file of another program is overwritten.

    Args:
        path: The file to replace or create.
        mode: `"wb"` or `"w"`. Text is written as UTF-8 without newline translation.
        sync: Flush the file and its folder to the disk. Without it, the old content survives a crash of this process
            but not necessarily of the machine.

    Yields:
        The open temporary file.

    Raises:
        OSError: If the file cannot be written.
    """
    target = Path(path)
    # A name of at most 255 bytes, whatever that of the target is.
    partial = target.with_name(f".modp-ti-{secrets.token_hex(8)}.partial")
    encoding, newline = (None, None) if "b" in mode else ("utf-8", "")
    opened = partial.open(mode.replace("w", "x"), encoding=encoding, newline=newline)
    try:
        with opened as file:
            yield file
            file.flush()
            if sync:
                os.fsync(file.fileno())
        os.replace(partial, target)
    except BaseException:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise
    if sync:
        sync_folder(target.parent)


def replace_file(path: str | os.PathLike[str], content: bytes) -> None:
    """Write `content` to `path` atomically, synced to the disk; see `replacing`."""
    with replacing(path) as file:
        file.write(content)


def replace_text(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` to `path` atomically as UTF-8, synced to the disk; see `replacing`."""
    replace_file(path, text.encode("utf-8"))


def write_picture(path: str | os.PathLike[str], image: NDArray[np.uint8]) -> None:
    """Write an image in the format of the path's suffix.

    Args:
        path: The file, for example `picture.png`.
        image: (H, W, 3) RGB or (H, W).

    Raises:
        OSError: If the file cannot be written.
    """
    import cv2

    # Encoded in memory, because `cv2.imwrite` does not report a full disk.
    _, data = cv2.imencode(Path(path).suffix, image[..., ::-1] if image.ndim == 3 else image)
    with replacing(path, sync=False) as file:
        file.write(data.tobytes())


@contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """Yield a path of the same name, its suffix in small letters, in a private folder next to `path`.

    The file or folder that is written there replaces `path` on exit, a folder only an empty one.

    Raises:
        OSError: If it cannot be written.
    """
    with tempfile.TemporaryDirectory(prefix=".modp-ti-", dir=path.parent, ignore_cleanup_errors=True) as folder:
        partial = Path(folder) / f"{path.stem}{path.suffix.lower()}"
        yield partial
        os.replace(partial, path)


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries to the disk, on file systems that support it."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)

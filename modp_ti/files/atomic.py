"""Files that appear whole or not at all, also where the machine stops in between."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

__all__ = ["replace_file", "replace_text", "replacing", "sync_folder", "write_picture"]


@contextmanager
def replacing(path: str | os.PathLike[str], mode: str = "wb", sync: bool = True) -> Iterator[IO]:
    """A file to write, beside `path`, which takes the place of what is there once all is written and on the disk.

    sync: wait for the disk; without, only a fault of this process leaves what was there before. Text is UTF-8, with
    plain line ends. Where writing fails nothing is left of it; raises OSError then.
    """
    target = Path(path)
    partial = target.with_name(target.name + ".partial")
    text = {} if "b" in mode else {"encoding": "utf-8", "newline": ""}
    try:
        with partial.open(mode, **text) as file:
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
    """`replacing` of the whole content."""
    with replacing(path) as file:
        file.write(content)


def replace_text(path: str | os.PathLike[str], text: str) -> None:
    """`replacing` of the whole text."""
    replace_file(path, text.encode("utf-8"))


def write_picture(path: str | os.PathLike[str], image: NDArray[np.uint8]) -> None:
    """A picture (H, W, 3) RGB or (H, W), in the format of the path's ending. Raises OSError where it cannot be written.

    OpenCV's own writer is silent on a full disk.
    """
    import cv2

    _, data = cv2.imencode(Path(path).suffix, image[..., ::-1] if image.ndim == 3 else image)
    with replacing(path, sync=False) as file:
        file.write(data.tobytes())


def sync_folder(folder: Path) -> None:
    """Have the disk know the folder's names, on file systems that can be asked to."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)

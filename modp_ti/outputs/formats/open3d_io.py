"""Imports Open3D on demand, and moves the files that it writes into place once they are complete."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from modp_ti.files.errors import InputError

__all__ = ["open3d", "written_aside"]


def open3d() -> ModuleType:
    """Import and return Open3D.

    Raises:
        InputError: If the import fails, most often because of a missing system library.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise InputError(
            f"Open3D does not start ({error}); on Debian or Ubuntu: apt-get install libusb-1.0-0 libgomp1 libgl1"
        ) from None
    return open3d


@contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """Yield a temporary path with the same suffix, in small letters, whose file replaces `path` on exit."""
    partial = path.with_name(f"{path.stem}.partial{path.suffix.lower()}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)

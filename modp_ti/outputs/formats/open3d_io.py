"""Imports Open3D on demand, and moves the files that it writes into place once they are complete."""

from __future__ import annotations

import os
import tempfile
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
    """Yield a path in a temporary folder, whose file replaces `path` on exit.

    Its name is the same, which some writers store, but for the suffix, which is in small letters.
    """
    with tempfile.TemporaryDirectory(prefix=".partial-", dir=path.parent) as folder:
        partial = Path(folder) / f"{path.stem}{path.suffix.lower()}"
        yield partial
        os.replace(partial, path)

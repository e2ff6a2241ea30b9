"""Open3D, imported where it is used, and files that it writes put in place whole."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from modp_ti.files.errors import InputError

__all__ = ["open3d", "written_aside"]


def open3d() -> ModuleType:
    """The module. Raises InputError where its import fails, most often for a missing system library."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise InputError(
            f"Open3D does not start ({error}); on Debian or Ubuntu: apt-get install libusb-1.0-0 libgomp1 libgl1"
        ) from None
    return open3d


@contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """A path of the same ending beside `path`, which what is written there replaces at the end."""
    partial = path.with_name(f"{path.stem}.partial{path.suffix}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)

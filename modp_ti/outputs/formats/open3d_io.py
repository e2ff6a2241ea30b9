"""Imports Open3D on demand."""

from __future__ import annotations

from types import ModuleType

from modp_ti.files.errors import InputError

__all__ = ["open3d"]


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

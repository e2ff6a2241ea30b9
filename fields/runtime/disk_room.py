"""Disk space that stays free while a map is made, so that it can be saved."""

from __future__ import annotations

import shutil
from pathlib import Path

__all__ = ["has_room"]

# Disk space that stays free [bytes].
KEPT_FREE = 1 << 30


def has_room(folder: Path, size: int) -> bool:
    """Return whether `KEPT_FREE` stays free on the folder's disk after writing `size` bytes. Raises OSError."""
    return shutil.disk_usage(folder).free >= KEPT_FREE + size

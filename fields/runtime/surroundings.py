"""What the engine needs from the process around it: address space, and a folder for its cache of kernels."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path

__all__ = ["notes", "provide_cache", "why_too_narrow"]

# Address space that a process needs [bytes]. The engine reserves memory by the gigabyte, most of which it never uses.
NEEDED = 3_400_000_000

notes: list[str] = []
"""What the user should know of the cache, in at most one line."""


def why_too_narrow() -> str | None:
    """Return in one line what a limit of the address space (`ulimit -v`) lacks, or None if there is enough."""
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY or limit >= NEEDED:
        return None
    return (
        f"this needs about 3.5 GB of address space, most of which stays unused, and the limit is {limit / 1e9:.1f} GB: "
        "raise it (ulimit -v, prlimit --as)"
    )


def provide_cache(package: str) -> None:
    """Give the engine a temporary cache folder where there is no home, or one that cannot be written.

    Without a home the engine aborts, and in one that it cannot write it crashes at the end of the process.
    """
    if os.name != "posix":
        return
    place, home = os.environ.get("XDG_CACHE_HOME"), os.environ.get("HOME")
    base = Path(place) if place else Path(home, ".cache") if home else None
    try:
        if base is not None:
            (base / package).mkdir(parents=True, exist_ok=True)
            if os.access(base / package, os.W_OK | os.X_OK):
                return
    except OSError:
        pass
    folder = tempfile.mkdtemp(prefix="modp-ti-cache-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)  # registered first, so called after the engine's reset
    os.environ["XDG_CACHE_HOME"] = folder
    os.environ.setdefault("MPLCONFIGDIR", folder)  # Open3D loads Matplotlib, which would complain
    notes.append(
        f"{base or 'the home folder'} cannot be written or is not there: kernels are kept until this process ends; set "
        "XDG_CACHE_HOME to keep them"
    )

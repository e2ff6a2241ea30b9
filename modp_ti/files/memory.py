"""Estimate of the memory that is available for reading files."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["available_memory"]

# Bytes assumed where the system does not report its memory.
ASSUMED = 4 << 30
CGROUP_LIMITS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


def available_memory() -> int:
    """Approximate bytes that this process can still allocate: the least that machine, container and rlimit allow."""
    return max(0, min(_of_machine(), *(_of_container(*files) for files in CGROUP_LIMITS), _of_process()))


def _of_machine() -> int:
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) << 10
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError, IndexError):
        return ASSUMED


def _of_container(limit: str, used: str) -> int:
    try:
        return int(Path(limit).read_text(encoding="ascii")) - int(Path(used).read_text(encoding="ascii"))
    except (OSError, ValueError):  # no such cgroup file, or its limit is "max"
        return 1 << 62


def _of_process() -> int:
    try:
        import resource

        soft, _ = resource.getrlimit(resource.RLIMIT_AS)
        if soft == resource.RLIM_INFINITY:
            return 1 << 62
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        return soft - pages * resource.getpagesize()
    except (ImportError, OSError, ValueError):
        return 1 << 62

"""Runs of `modp-ti` in processes of their own that may be killed, and what they left."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from modp_ti.files.errors import InputError

__all__ = ["COMPARED", "Ended", "contents", "finished", "metrics", "require_success", "run_until"]

# What must be the same after an interrupted run.
COMPARED = ("splats.ply", "trajectory.txt")


@dataclass(frozen=True)
class Ended:
    """How a run ended. killed: by us. seconds: since its start. first_snapshot: when it had one, or None."""

    code: int
    killed: bool
    seconds: float
    first_snapshot: float | None
    said: str


def run_until(arguments: list[str], snapshot: Path, kill_after: float | None = None, mapping: bool = False) -> Ended:
    """`modp-ti run` with these arguments; `kill -9` after so many seconds, if it is there still.

    mapping: they count from when it has written a snapshot, however long it took to start.
    """
    before = _stamp(snapshot)
    started, first = time.monotonic(), None
    process = subprocess.Popen(
        [sys.executable, "-m", "modp_ti.run", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    killed = False
    while process.poll() is None:
        elapsed = time.monotonic() - started
        if first is None and _stamp(snapshot) != before:
            first = elapsed
        since = first if mapping else 0.0
        if kill_after is not None and since is not None and elapsed >= since + kill_after:
            process.kill()
            killed = True
            break
        time.sleep(0.02)
    said = process.communicate()[1]
    return Ended(process.returncode, killed, time.monotonic() - started, first, said)


def _stamp(file: Path) -> int:
    try:
        return file.stat().st_mtime_ns
    except FileNotFoundError:
        return 0


def finished(arguments: list[str], output: Path) -> Ended:
    """The same, to its end. Raises InputError with what it said where that is not a good one."""
    ended = run_until(arguments, output / "snapshot.npz")
    require_success(ended, output)
    return ended


def require_success(ended: Ended, output: Path) -> None:
    """Raises InputError for a run that ended badly by itself."""
    if ended.code:
        raise InputError(f"the run into {output} ended with {ended.code}: {ended.said.strip()[-500:]}")


def contents(output: Path) -> dict[str, bytes]:
    """The files that are compared."""
    return {name: (output / name).read_bytes() for name in COMPARED}


def metrics(output: Path) -> dict[str, Any]:
    """metrics.json of a finished run."""
    return json.loads((output / "metrics.json").read_text(encoding="utf-8"))

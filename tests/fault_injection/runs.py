"""Runs `modp-ti` in separate processes that may be killed, and reads their output."""

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

# Files that an interrupted and resumed run must reproduce exactly.
COMPARED = ("splats.ply", "trajectory.txt")


@dataclass(frozen=True)
class Ended:
    """How a run ended.

    Attributes:
        code: Exit code.
        killed: Whether this program killed it.
        seconds: Time since its start [s].
        first_snapshot: When its first snapshot appeared [s], or None.
        said: Its standard error.
    """

    code: int
    killed: bool
    seconds: float
    first_snapshot: float | None
    said: str


def run_until(arguments: list[str], snapshot: Path, kill_after: float | None = None, mapping: bool = False) -> Ended:
    """Run `modp-ti run`, and kill it with SIGKILL if it is still running after `kill_after`.

    Args:
        arguments: Arguments of the command.
        snapshot: The run's snapshot file.
        kill_after: Time until the kill [s], None to let it finish.
        mapping: Count this time from the first snapshot instead of from the start.
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
    """Run `modp-ti run` to its end. Raises InputError with its messages if it fails."""
    ended = run_until(arguments, output / "snapshot.npz")
    require_success(ended, output)
    return ended


def require_success(ended: Ended, output: Path) -> None:
    """Raise InputError if a run failed."""
    if ended.code:
        raise InputError(f"the run into {output} ended with {ended.code}: {ended.said.strip()[-500:]}")


def contents(output: Path) -> dict[str, bytes]:
    """Return the content of the files to compare."""
    return {name: (output / name).read_bytes() for name in COMPARED}


def metrics(output: Path) -> dict[str, Any]:
    """Read metrics.json of a finished run."""
    return json.loads((output / "metrics.json").read_text(encoding="utf-8"))

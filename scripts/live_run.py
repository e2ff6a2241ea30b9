"""Runs of `modp-ti` in a process of their own, whose memory is watched and for which faults are made."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import TextIO

from live_camera import environment

from fields.runtime.disk_room import KEPT_FREE
from modp_ti.files.errors import InputError

__all__ = ["Faults", "command", "memory_of"]

# Time between two looks at the memory of a run, and at the frames that it has stored [s].
SAMPLED, GLANCE = 5.0, 0.05
# What the tracker's process is called by.
TRACKER = "tracking_process.child"


@dataclass(frozen=True)
class Faults:
    """Faults on the side of the run.

    Attributes:
        kill_tracker: Number of delivered frames after which the tracker's process is killed with signal 9.
        full_disk: Space for frames on the disk of the temporary folder [MB], beside what the program leaves free.
    """

    kill_tracker: int | None = None
    full_disk: float | None = None

    @property
    def told(self) -> list[str]:
        """The faults in a few words each."""
        killed = None if self.kill_tracker is None else f"tracker killed after {self.kill_tracker} frames"
        full = None if self.full_disk is None else f"disk full after {self.full_disk:g} MB"
        return [fault for fault in (killed, full) if fault]

    def require_possible(self) -> None:
        """Raise InputError if this machine does not let this user make a small disk."""
        if self.full_disk is None:
            return
        if shutil.which("unshare") is None or subprocess.run([*_namespace(), "true"], check=False).returncode:
            raise InputError("--full-disk needs a mount namespace (`unshare`): Linux, as root or with user namespaces")

    def wrapped(self, line: list[str], temporary: Path) -> list[str]:
        """Return the command line, if the disk is to be full with a small file system for its temporary folder."""
        if self.full_disk is None:
            return line
        # The file system exists for this process and its children only, and vanishes with them.
        script = 'mount -t tmpfs -o "size=$1" modp-ti "$2" && shift 2 && exec "$@"'
        size = KEPT_FREE + round(self.full_disk * 1e6)
        return [*_namespace(), "sh", "-c", script, "sh", str(size), str(temporary), *line]


def _namespace() -> list[str]:
    return ["unshare", "--mount", *([] if os.geteuid() == 0 else ["--map-root-user"])]


def command(
    *arguments: str, output: TextIO | None = None, faults: Faults | None = None, temporary: Path | None = None
) -> tuple[int, dict[str, list[float]]]:
    """Run `modp-ti` with these arguments.

    Args:
        *arguments: The arguments.
        output: What it prints goes here, None for standard error.
        faults: Faults to make.
        temporary: Its folder for temporary files, None for the system's.

    Returns:
        Its exit code, and the memory [MB] of the mapper's and of the tracker's process every `SAMPLED` seconds.
    """
    faults = faults or Faults()
    line, to = [sys.executable, "-m", "modp_ti.commands.app", *arguments], output or sys.stderr
    variables: Mapping[str, str] = environment() if temporary is None else {**environment(), "TMPDIR": str(temporary)}
    if temporary is not None:
        line = faults.wrapped(line, temporary)
    process = subprocess.Popen(line, stdout=to, stderr=to, env=variables)
    memory: dict[str, list[float]] = {"mapper": [], "tracker": []}
    try:
        with _killing(process.pid, faults.kill_tracker, temporary):
            while True:
                try:
                    return process.wait(SAMPLED), memory
                except subprocess.TimeoutExpired:
                    tracker = _tracker(process.pid)
                    memory["mapper"].append(round(memory_of(process.pid), 1))
                    memory["tracker"].append(0.0 if tracker is None else round(memory_of(tracker), 1))
    finally:
        process.terminate()
        process.wait()


def memory_of(process: int) -> float:
    """Return the resident memory of a process [MB], as Linux tells it; 0 if it does not."""
    try:
        pages = int((Path("/proc") / str(process) / "statm").read_text().split()[1])
    except OSError:  # it has ended, or this is no Linux
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / (1 << 20)


def _tracker(process: int) -> int | None:
    """Return the tracker's process among the children of a run, None if there is none."""
    place = Path("/proc") / str(process)
    try:
        children = [int(word) for file in place.glob("task/*/children") for word in file.read_text().split()]
        return next((c for c in children if TRACKER in (Path("/proc") / str(c) / "cmdline").read_text()), None)
    except OSError:
        return None


@contextmanager
def _killing(process: int, after: int | None, temporary: Path | None) -> Iterator[None]:
    """Kill the tracker of a run when it has stored the frame number `after`, unless that is None."""
    over = Event()

    def watch(temporary: Path, after: int) -> None:
        while not over.wait(GLANCE):
            tracker = _tracker(process)
            if tracker is not None and len(list(temporary.glob("modp-ti-live-*/[0-9]*.png"))) >= after:
                os.kill(tracker, signal.SIGKILL)
                return

    if after is None or temporary is None:
        yield
        return
    thread = Thread(target=watch, args=(temporary, after), name="killer", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()

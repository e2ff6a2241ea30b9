"""Runs the command line on a malformed input, in this process, and checks the result.

Expected are a one-line message, exit code 2, no output files and bounded memory.
"""

from __future__ import annotations

import io
import os
import shutil
import signal
import sys
import tempfile
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout
from pathlib import Path

from tests.fault_injection.malformed_cases import Case
from tests.fault_injection.samples import write_sample

__all__ = ["fault_of", "write_accepted_sample"]

# Bytes that a command may allocate in addition to twice the size of its input.
BASE = 16 << 20
# Additional allowance for native libraries, measured as resident memory by the OS.
NATIVE_BASE = 96 << 20
# Limits of wall time and CPU time after which a command counts as hanging [s].
SECONDS, PROCESSOR_SECONDS = 900, 30


def write_accepted_sample(reader: str, folder: Path) -> Path:
    """Write the reader's valid sample to a new folder, and check that the command accepts it.

    This also imports the command's modules before memory is measured.
    """
    arguments = write_sample(reader, folder).arguments
    kept = _listing(folder)
    code, text = _command(folder, arguments, impatient=False)
    assert code in (0, 1), f"the valid sample of {reader} is refused: {text}"
    for name in _listing(folder) - kept:
        (folder / name).unlink()
    return folder


def fault_of(case: Case, sample: Path, folder: Path) -> str:
    """Create the malformed input in a new folder and run the command on it.

    Args:
        case: What to corrupt.
        sample: Folder of the reader's valid sample.
        folder: Folder of the malformed input.

    Returns:
        What was wrong with the command's reaction and what it printed, or an empty text.
    """
    shutil.copytree(sample, folder, symlinks=True)
    case.corrupt(folder / case.file)
    before = _listing(folder)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file() and not file.is_symlink())
    with _tracing():
        resident = _reset_resident()
        tracemalloc.reset_peak()
        held = tracemalloc.get_traced_memory()[0]
        code, text = _command(folder, case.arguments)
        allocated = tracemalloc.get_traced_memory()[1] - held
        native = _status("VmHWM:") - resident
    lines = text.strip().splitlines()
    left = _listing(folder) - before
    expected_lines = 2 if case.arguments[0] == "check" else 1
    faults = {
        f"exit code {code}": code != 2,
        "a traceback": "Traceback" in text,
        f"{len(lines)} lines": len(lines) != expected_lines or not lines[0].startswith(("unusable: ", "error: ")),
        f"left {sorted(left)}": bool(left),
        f"allocated {allocated >> 20} MiB for {size} bytes": allocated > BASE + 2 * size,
        f"took {native >> 20} MiB for {size} bytes": native > NATIVE_BASE + 2 * size,
    }
    return next((f"{fault}: {text.strip()[-2000:]}" for fault, is_so in faults.items() if is_so), "")


def _command(folder: Path, arguments: tuple[str, ...], impatient: bool = True) -> tuple[int, str]:
    """Run `modp-ti` in the folder and return its exit code and all output, including that of native libraries."""
    from modp_ti.commands.app import app

    here = Path.cwd()
    with tempfile.TemporaryFile() as output:
        try:
            os.chdir(folder)
            with _everything_to(output.fileno()), _impatient() if impatient else nullcontext():
                app(list(arguments))
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
        except BaseException as error:
            output.write(f"Traceback: {error!r}".encode())
            code = -1
        finally:
            os.chdir(here)
        output.seek(0)
        return code, output.read().decode(errors="replace")


@contextmanager
def _everything_to(descriptor: int) -> Iterator[None]:
    kept = [os.dup(1), os.dup(2)]
    sys.stdout.flush()
    sys.stderr.flush()
    with io.TextIOWrapper(os.fdopen(os.dup(descriptor), "wb"), encoding="utf-8", line_buffering=True) as text:
        try:
            os.dup2(descriptor, 1)
            os.dup2(descriptor, 2)
            with redirect_stdout(text), redirect_stderr(text):
                yield
        finally:
            for number, old in zip((1, 2), kept, strict=True):
                os.dup2(old, number)
                os.close(old)


@contextmanager
def _impatient() -> Iterator[None]:
    """Raise an error if the command hangs."""

    def late(*_: object) -> None:
        raise TimeoutError(f"hangs: {PROCESSOR_SECONDS} s of the processor, or {SECONDS} s, have passed")

    timers = {signal.SIGALRM: (signal.ITIMER_REAL, SECONDS), signal.SIGPROF: (signal.ITIMER_PROF, PROCESSOR_SECONDS)}
    before = {number: signal.signal(number, late) for number in timers}
    for timer, seconds in timers.values():
        signal.setitimer(timer, seconds)
    try:
        yield
    finally:
        for number, (timer, _) in timers.items():
            signal.setitimer(timer, 0)
            signal.signal(number, before[number])


@contextmanager
def _tracing() -> Iterator[None]:
    started = not tracemalloc.is_tracing()
    if started:
        tracemalloc.start()
    try:
        yield
    finally:
        if started:
            tracemalloc.stop()


def _listing(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def _reset_resident() -> int:
    """Reset the OS's record of the peak resident memory, and return the current one in bytes."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass
    return _status("VmRSS:")


def _status(key: str) -> int:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:  # not Linux: only Python's own count is used
        return 0
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith(key))

"""Runs the command line on malformed inputs, in this process, and checks the result.

Expected are a one-line message, exit code 2, no output files and bounded memory.

`python scripts/fault_injection/malformed.py [READER ...]` prints a table by reader, and the failures.
"""

from __future__ import annotations

import io
import os
import shutil
import signal
import sys
import tempfile
import tracemalloc
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "scripts")]

from fault_injection.malformed_cases import CASES, Case  # noqa: E402 (found through the path above)
from fault_injection.samples import SAMPLES, write_sample  # noqa: E402

__all__ = ["BASE", "Outcome", "malformed_inputs", "markdown", "run_case"]

BASE = 16 << 20
"""Bytes that a command may allocate in addition to twice the size of its input."""
# Additional allowance for native libraries, measured as resident memory by the OS.
NATIVE_BASE = 96 << 20
# Limits of wall time and CPU time after which a command counts as hanging [s].
SECONDS, PROCESSOR_SECONDS = 900, 30


@dataclass(frozen=True)
class Outcome:
    """Result of a malformed input.

    Attributes:
        case: The input.
        fault: What was wrong with the command's reaction, empty if nothing.
        line: The message.
        allocated: Bytes that Python allocated at most.
    """

    case: Case
    fault: str
    line: str
    allocated: int


def malformed_inputs(readers: Iterable[str] = (), cases: Sequence[Case] = CASES) -> Iterator[Outcome]:
    """Run all cases, or those of some readers, one after the other."""
    wanted = set(readers)
    cases = [case for case in cases if not wanted or case.reader in wanted]
    with tempfile.TemporaryDirectory(prefix="modp-ti-malformed-") as folder:
        for reader in dict.fromkeys(case.reader for case in cases):
            sample = Path(folder) / reader
            write_sample(reader, sample)
            fault = _accepted(sample, SAMPLES[reader][0].arguments)
            assert not fault, f"the valid sample of {reader} is refused: {fault}"
            for case in cases:
                if case.reader == reader:
                    with _tracing():
                        outcome = run_case(case, sample, Path(folder) / "case")
                    yield outcome


def run_case(case: Case, sample: Path, folder: Path) -> Outcome:
    """Create the malformed input in `folder` from the valid one in `sample`, and run the command on it."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(sample, folder, symlinks=True)
    case.corrupt(folder / case.file)
    before = _listing(folder)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file() and not file.is_symlink())
    resident = _reset_resident()
    tracemalloc.reset_peak()
    held = tracemalloc.get_traced_memory()[0]
    code, text = _command(folder, case.arguments)
    allocated = tracemalloc.get_traced_memory()[1] - held
    native = _peak_resident() - resident
    lines = text.strip().splitlines()
    fault = ""
    if code != 2:
        fault = f"exit code {code}"
    elif "Traceback" in text:
        fault = "a traceback"
    elif len(lines) != (2 if case.arguments[0] == "check" else 1) or not lines[0].startswith(("unusable: ", "error: ")):
        fault = f"{len(lines)} lines"
    elif _listing(folder) != before:
        fault = f"left {sorted(_listing(folder) - before)}"
    elif allocated > BASE + 2 * size:
        fault = f"allocated {allocated >> 20} MiB for {size} bytes"
    elif native > NATIVE_BASE + 2 * size:
        fault = f"took {native >> 20} MiB for {size} bytes"
    return Outcome(case, fault, text.strip()[-2000:] if fault else lines[0], allocated)


def markdown(outcomes: list[Outcome]) -> str:
    """Return a table by reader."""
    rows = ["| reader | malformed inputs | one line, exit code 2, nothing left | most allocated |", "|---|---|---|---|"]
    for reader in dict.fromkeys(outcome.case.reader for outcome in outcomes):
        of = [outcome for outcome in outcomes if outcome.case.reader == reader]
        good = sum(not outcome.fault for outcome in of)
        rows.append(f"| {reader} | {len(of)} | {good} | {max(o.allocated for o in of) / 2**20:.1f} MiB |")
    good = sum(not outcome.fault for outcome in outcomes)
    most = max((outcome.allocated for outcome in outcomes), default=0) / 2**20
    return "\n".join([*rows, f"| **all** | {len(outcomes)} | {good} | {most:.1f} MiB |"])


def _accepted(folder: Path, arguments: tuple[str, ...]) -> str:
    """Return the message if a command refuses a valid sample.

    This also imports the command's modules before memory is measured.
    """
    kept = _listing(folder)
    code, text = _command(folder, arguments, impatient=False)
    for name in _listing(folder) - kept:
        (folder / name).unlink()
    return "" if code in (0, 1) else text


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


def _peak_resident() -> int:
    return _status("VmHWM:")


def _status(key: str) -> int:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:  # not Linux: only Python's own count is used
        return 0
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith(key))


if __name__ == "__main__":
    found = []
    for outcome in malformed_inputs(sys.argv[1:]):
        found.append(outcome)
        if outcome.fault:
            case = outcome.case
            print(
                f"{case.reader}: {case.file}: {case.name}: {outcome.fault}\n{outcome.line}\n",
                file=sys.stderr,
                flush=True,
            )
    print(markdown(found))
    sys.exit(any(outcome.fault for outcome in found))

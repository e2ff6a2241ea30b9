"""Coverage-guided fuzzing of the readers: inputs that reach new branches are kept and mutated further.

Each reader runs in its own process and starts with the samples and the corpus in tests/corpus/READER. A reader stops if
it raises anything but an InputError, warns, exceeds --rss MiB or takes more than 20 seconds. The input is then saved as
tests/corpus/READER/crash-..., which the tests replay; it stays there after the fault is fixed. --keep adds the smallest
inputs that reach code which the corpus did not.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from importlib import import_module
from pathlib import Path
from typing import NoReturn

CORPUS = Path(__file__).resolve().parents[1] / "corpus"

TIMEOUT = 20  # seconds for one input
LONGEST = 1 << 14  # bytes of an input


def main() -> None:
    """Fuzz the readers one after the other and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reader", nargs="*", help="which of them; all where none is named")
    parser.add_argument("--seconds", type=int, default=60, help="for each (default %(default)s)")
    parser.add_argument("--rss", type=int, default=2048, help="MiB that the process may have (default %(default)s)")
    parser.add_argument("--keep", type=int, default=0, metavar="N", help="add up to N found inputs to the corpus")
    options = parser.parse_args()
    import atheris

    for kernels in ("online", "torch_checkpoint"):  # compiled by Taichi and PyTorch: nothing to instrument
        import_module(f"pipelines.{kernels}")
    with atheris.instrument_imports(include=["modp_ti"]):
        from tests.fault_injection.readers import READERS, import_readers

        unknown = [name for name in options.reader if name not in READERS]
        if unknown:
            parser.error(f"no reader {unknown[0]}; there are {', '.join(READERS)}")
        import_readers()
    print("| reader | seconds | of the processor | inputs tried | of them kept, for new code | stopped by |")
    print("|---|---|---|---|---|---|", flush=True)
    stopped = [name for name in options.reader or READERS if one(name, options)]
    sys.exit(1 if stopped else 0)


def one(name: str, options: argparse.Namespace) -> bool:
    """Fuzz a reader in its own process, print its row, and return whether a fault stopped it."""
    kept = CORPUS / name
    kept.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="modp-ti-fuzz-") as folder:
        found, log = Path(folder) / "found", Path(folder) / "log"
        found.mkdir()
        began = time.monotonic()
        child = os.fork()
        if child == 0:
            try:
                fuzz(name, Path(folder), kept, options)
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(1)
        _, status, used = os.wait4(child, 0)
        text = log.read_text(errors="replace") if log.exists() else ""
        runs = [int(number) for number in re.findall(r"(?:^#|^Done |executed_units: *)(\d+)", text, re.MULTILINE)]
        crashes = sorted(kept.glob("crash-new-*"))
        reason = "" if status == 0 and not crashes else _reason(text)
        new = sorted(found.iterdir(), key=lambda file: (file.stat().st_size, file.name))
        seconds = [f"{time.monotonic() - began:.0f}", f"{used.ru_utime + used.ru_stime:.0f}"]
        row = [name, *seconds, f"{max(runs, default=0):,}", str(len(new)), reason]
        print(f"| {' | '.join(row)} |", flush=True)
        for crash in crashes:
            crash.rename(crash.with_name(crash.name.replace("crash-new-", "crash-")[:22]))
        for file in new[: options.keep]:
            shutil.copyfile(file, kept / file.name[:16])
        if reason:
            print(text[-4000:], file=sys.stderr, flush=True)
    return bool(reason)


def _reason(text: str) -> str:
    """Return one line that says why the fuzzer stopped."""
    python = re.findall(r"^ *=* ?(\w[\w.]*(?:Error|Exception|Warning)\b.*)$", text, re.MULTILINE)
    native = re.findall(r"==\d+== ERROR: (.*)", text)
    return (python[-1] if python else native[-1] if native else "it did not start").replace("|", "/")[:160]


def fuzz(name: str, folder: Path, kept: Path, options: argparse.Namespace) -> NoReturn:
    """Fuzz a reader in this process. libFuzzer ends the process."""
    import atheris

    from tests.fault_injection.readers import READERS, seeds

    log = os.open(folder / "log", os.O_WRONLY | os.O_CREAT)
    for descriptor in (1, 2):
        os.dup2(log, descriptor)
    reader = READERS[name]
    sample, start = folder / "sample", folder / "seeds"
    start.mkdir()
    tempfile.tempdir = str(folder)
    for number, content in enumerate(seeds(reader, sample)):
        assert reader(sample, content), f"sample {number} of {name} is not taken"
        (start / f"seed-{number}").write_bytes(content)
    warnings.simplefilter("error", RuntimeWarning)
    limits = [f"-max_total_time={options.seconds}", f"-rss_limit_mb={options.rss}", f"-timeout={TIMEOUT}"]
    more = [f"-max_len={LONGEST}", f"-artifact_prefix={kept}/crash-new-", "-print_final_stats=1"]
    places = [str(folder / "found"), str(kept), str(start)]

    def read(data: bytes) -> None:
        try:
            reader(sample, data)
        except BaseException:
            (kept / f"crash-new-{hashlib.sha1(data).hexdigest()}").write_bytes(data)
            raise

    atheris.Setup([sys.argv[0], *limits, *more, *places], read)
    atheris.Fuzz()
    os._exit(0)


if __name__ == "__main__":
    main()

"""Coverage-guided fuzzing of a reader: bytes that reach new branches are kept and changed further.

Each reader runs in a process of its own, which starts with the samples and with what tests/corpus/READER keeps. What a
reader must never do stops it: raise anything but an InputError, warn, take more than --rss MiB, or 20 seconds. Such an
input is written to tests/corpus/READER/crash-..., where the tests replay it from then on; once it is mended, it stays
under that name. `--keep` adds the smallest inputs that reach what the corpus did not.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CORPUS = ROOT / "tests" / "corpus"
sys.path[:0] = [str(ROOT), str(ROOT / "scripts")]

# Native decoders are not instrumented, and those of some inputs are slow: one input may take so long [s].
TIMEOUT = 20
LONGEST = 1 << 14  # bytes of an input


def main() -> None:
    """Fuzz one reader after the other and print a table."""
    from fault_injection.readers import READERS

    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=f"readers: {', '.join(READERS)}",
    )
    parser.add_argument("reader", nargs="*", help="which of them; all where none is named")
    parser.add_argument("--seconds", type=int, default=60, help="for each (default %(default)s)")
    parser.add_argument("--rss", type=int, default=2048, help="MiB that the process may have (default %(default)s)")
    parser.add_argument("--keep", type=int, default=0, metavar="N", help="add up to N found inputs to the corpus")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    unknown = [name for name in options.reader if name not in READERS]
    if unknown:
        parser.error(f"no reader {unknown[0]}; there are {', '.join(READERS)}")
    if options.child:
        fuzz(options.reader[0], options.seconds, options.rss)
        return
    print("| reader | seconds | inputs tried | inputs that reach new code | stopped by |")
    print("|---|---|---|---|---|", flush=True)
    stopped = False
    for name in options.reader or READERS:
        stopped |= one(name, options)
    sys.exit(1 if stopped else 0)


def one(name: str, options: argparse.Namespace) -> bool:
    """Fuzz a reader in a process of its own, print its row, and say whether it was stopped."""
    kept = CORPUS / name
    kept.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="modp-ti-fuzz-") as folder:
        found = Path(folder) / "found"
        found.mkdir()
        command = [
            sys.executable,
            __file__,
            name,
            "--child",
            "--seconds",
            str(options.seconds),
            "--rss",
            str(options.rss),
        ]
        environment = {**os.environ, "MODP_FUZZ_FOUND": str(found), "TMPDIR": folder, "PYTHONPATH": _path()}
        log = Path(folder) / "log"
        with log.open("wb") as output:
            subprocess.run(command, stdout=output, stderr=subprocess.STDOUT, env=environment, check=False)
        text = log.read_text(errors="replace")
        runs = [int(n) for n in re.findall(r"^#(\d+)", text, re.MULTILINE)]
        seconds = re.findall(r"in (\d+) second", text)
        crashes = sorted(kept.glob("crash-new-*"))
        reason = _reason(text) if crashes or not seconds else ""
        new = sorted((f for f in found.iterdir() if f.is_file()), key=lambda f: (f.stat().st_size, f.name))
        row = [name, seconds[-1] if seconds else "-", f"{runs[-1] if runs else 0:,}", str(len(new)), reason]
        print(f"| {' | '.join(row)} |", flush=True)
        for crash in crashes:
            crash.rename(crash.with_name(crash.name.replace("crash-new-", "crash-")))
        for file in new[: options.keep]:
            shutil.copyfile(file, kept / file.name[:16])
        if reason:
            print(text[-4000:], file=sys.stderr)
    return bool(reason)


def _path() -> str:
    return os.pathsep.join(filter(None, [str(ROOT), str(ROOT / "scripts"), os.environ.get("PYTHONPATH", "")]))


def _reason(text: str) -> str:
    """What stopped the fuzzer, in a line."""
    python = re.findall(r"^(\w[\w.]*(?:Error|Exception|Warning)\b.*)$", text, re.MULTILINE)
    native = re.findall(r"==\d+== ERROR: (.*)", text)
    return (python[-1] if python else native[-1] if native else "it did not start").replace("|", "/")[:160]


def fuzz(name: str, seconds: int, rss: int) -> None:
    """Fuzz one reader in this process; libFuzzer ends it."""
    import atheris

    with atheris.instrument_imports(include=["modp_ti", "pipelines.weights", "fields"]):
        from fault_injection.readers import READERS, seeds

        reader = READERS[name]
        folder = Path(tempfile.mkdtemp(prefix="sample-")) / "sample"
        contents = seeds(reader, folder)
        for content in contents:
            assert reader(folder, content), f"the sample of {name} is not taken"
    start = folder.parent / "seeds"
    start.mkdir()
    for number, content in enumerate(contents):
        (start / f"seed-{number}").write_bytes(content)
    warnings.simplefilter("error", RuntimeWarning)
    kept = CORPUS / name
    arguments = [
        *(f"-max_total_time={seconds}", f"-rss_limit_mb={rss}", f"-timeout={TIMEOUT}", f"-max_len={LONGEST}"),
        *(f"-artifact_prefix={kept}/crash-new-", "-print_final_stats=1", "-verbosity=1"),
        *(os.environ["MODP_FUZZ_FOUND"], str(kept), str(start)),
    ]
    atheris.Setup([sys.argv[0], *arguments], lambda data: reader(folder, data))
    atheris.Fuzz()


if __name__ == "__main__":
    main()

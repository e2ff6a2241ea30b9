"""Coverage-guided fuzzing of the readers: inputs that reach new branches are kept and mutated further.

Each kind is read in its own process, which starts with the corpus. It stops if a reader raises anything but an
InputError, warns, exceeds --rss MiB or takes more than 20 seconds. That input joins the corpus, and so do, with --keep,
the smallest ones that reach code which the corpus did not. The first byte of an input chooses the file of the sample.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import sys
import tempfile
import warnings
from pathlib import Path
from typing import NoReturn

import atheris

with atheris.instrument_imports(include=["modp_ti"]):
    from tests.nightly.corpus import ALONE, FILES, add_to_corpus, corpus, is_taken
    from tests.samples.kinds import write_sample

TIMEOUT = 20  # seconds for one input
LONGEST = 1 << 14  # bytes of an input


def main() -> None:
    """Fuzz the kinds one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(FILES)}; all where none is named")
    parser.add_argument("--seconds", type=int, default=60, help="for each (default %(default)s)")
    parser.add_argument("--rss", type=int, default=2048, help="MiB that the process may have (default %(default)s)")
    parser.add_argument("--keep", type=int, default=0, metavar="N", help="add up to N found inputs to the corpus")
    options = parser.parse_args()
    if unknown := set(options.kinds).difference(FILES):
        parser.error(f"no kind {unknown.pop()}; there are {', '.join(FILES)}")
    stopped = [kind for kind in options.kinds or FILES if _stopped(kind, options)]
    sys.exit(1 if stopped else 0)


def _stopped(kind: str, options: argparse.Namespace) -> bool:
    """Fuzz a kind in its own process, print what came of it, and return whether a fault stopped it."""
    with tempfile.TemporaryDirectory(prefix="modp-ti-fuzz-") as folder:
        (Path(folder) / "found").mkdir()
        child = os.fork()
        if child == 0:
            try:
                _fuzz(kind, Path(folder), options)
            finally:
                os._exit(1)
        status = os.waitpid(child, 0)[1]
        text = (Path(folder) / "log").read_text(errors="replace")
        new = sorted((Path(folder) / "found").iterdir(), key=lambda file: (file.stat().st_size, file.name))
        crashes = list(Path(folder).glob("crash-*"))
        tried = max([int(number) for number in re.findall(r"(?:^#|executed_units: *)(\d+)", text, re.M)], default=0)
        print(f"{kind}: {tried:,} inputs, {len(new)} of them reach new code, {len(crashes)} stop it", flush=True)
        if status != 0:
            print(text[-4000:], file=sys.stderr, flush=True)
        kept = [file.read_bytes() for file in [*crashes, *new[: options.keep]]]
        add_to_corpus(kind, ((_split(kind, data)[0], hashlib.sha1(data).hexdigest()[:10], data[1:]) for data in kept))
    return status != 0


def _split(kind: str, data: bytes) -> tuple[str, bytes]:
    return FILES[kind][data[0] % len(FILES[kind]) if data else 0], data[1:]


def _fuzz(kind: str, folder: Path, options: argparse.Namespace) -> NoReturn:
    """Fuzz a kind in this process. libFuzzer ends the process."""
    log = os.open(folder / "log", os.O_WRONLY | os.O_CREAT)
    os.dup2(log, 1)
    os.dup2(log, 2)
    sample, start = folder / "sample", folder / "seeds"
    start.mkdir()
    sample.mkdir() if kind in ALONE else write_sample(kind, sample)
    seeds = corpus()[kind] + [(file, (sample / file).read_bytes()) for file in FILES[kind] if kind not in ALONE]
    for number, (file, content) in enumerate(seeds):
        (start / str(number)).write_bytes(bytes([FILES[kind].index(file)]) + content)
    warnings.simplefilter("error", RuntimeWarning)
    arguments = [f"-max_total_time={options.seconds}", f"-rss_limit_mb={options.rss}", f"-timeout={TIMEOUT}"]
    arguments += [f"-max_len={LONGEST}", f"-artifact_prefix={folder}/", "-print_final_stats=1"]
    atheris.Setup(
        [sys.argv[0], *arguments, str(folder / "found"), str(start)],
        lambda data: is_taken(kind, sample, _split(kind, data)),
    )
    atheris.Fuzz()
    os._exit(0)


if __name__ == "__main__":
    main()

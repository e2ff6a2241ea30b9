"""Fault injection for docs/reliability.md: cause faults, check the outcome of the run and print tables.

kills   kill a small run at random moments and resume it; the map must be identical to that of an undisturbed run
stream  map a recording with a tenth of its frames corrupted, and the intact one for comparison
soak    map a long recording and measure the memory of the process
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from modp_ti.files.errors import InputError
from tests.fault_injection.kills import kill_and_resume, kills_table
from tests.fault_injection.soak import soak, soak_table
from tests.fault_injection.stream import map_both, stream_table

PARTS = ("kills", "stream", "soak")


def main() -> None:
    """Run the tests, then print and write the tables. The exit code is 2 if a run fails unexpectedly."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: scripts/faults kills --kills 10 -o out/faults",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"one of {', '.join(PARTS)}; default: all of them")
    parser.add_argument("-o", "--output", required=True, type=Path, help="folder of the runs and of faults.md")
    parser.add_argument("--kills", type=int, default=50, metavar="N", help="number of kills (default 50)")
    parser.add_argument("--frames", type=int, default=20_000, metavar="N", help="length of the soak (default 20,000)")
    parser.add_argument("--memory", type=float, metavar="GB", help="mapping.memory of the soak (default: no limit)")
    parser.add_argument("--seed", type=int, default=0, help="seed of all randomness (default 0)")
    arguments = parser.parse_args()
    unknown = set(arguments.parts).difference(PARTS)
    if unknown:
        parser.error(f"{unknown.pop()} is none of {', '.join(PARTS)}")
    output = arguments.output.resolve()
    output.mkdir(parents=True, exist_ok=True)
    try:
        tables = [table(part, output, arguments) for part in arguments.parts or PARTS]
    except InputError as error:
        parser.exit(2, f"error: {error}\n")
    text = "\n\n".join(tables) + "\n"
    (output / "faults.md").write_text(text, encoding="utf-8")
    print(text, end="")


def table(part: str, output: Path, arguments: argparse.Namespace) -> str:
    """Run one test and return its table as Markdown."""

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    if part == "kills":
        return kills_table(kill_and_resume(output / part, arguments.kills, arguments.seed, say))
    if part == "stream":
        return stream_table(map_both(output / part, arguments.seed, say))
    return soak_table(soak(arguments.frames, arguments.memory, say))


if __name__ == "__main__":
    main()

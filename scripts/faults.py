"""Fault injection for docs/reliability.md: cause faults, check the outcome of the run and print tables.

kills      kill a small run at random moments and resume it; the map must be identical to that of an undisturbed run
stream     map a recording with a tenth of its frames corrupted, and the intact one for comparison
soak       map a long recording and measure the memory of the process
malformed  corrupt the inputs of every reader in hundreds of ways; each must give one clear line
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from experiments import write_report

from modp_ti.files.errors import InputError

Say = Callable[[str], None]
Part = Callable[[argparse.Namespace, Say], str]


def kills(arguments: argparse.Namespace, say: Say) -> str:
    """Return the table of the kills."""
    from fault_injection.kills import kill_and_resume, kills_table

    return kills_table(kill_and_resume(arguments.output / "kills", arguments.kills, arguments.seed, say))


def stream(arguments: argparse.Namespace, say: Say) -> str:
    """Return the table of the recording with faulty frames."""
    from fault_injection.stream import map_both, stream_table

    return stream_table(map_both(arguments.output / "stream", arguments.seed, say))


def soak(arguments: argparse.Namespace, say: Say) -> str:
    """Return the table of the soak test."""
    from fault_injection.soak import soak as run_soak
    from fault_injection.soak import soak_table

    return soak_table(run_soak(arguments.frames, arguments.memory, say))


def malformed(arguments: argparse.Namespace, say: Say) -> str:
    """Return the table of the malformed inputs."""
    from fault_injection.malformed import malformed_inputs, markdown

    return markdown(list(malformed_inputs()))


PARTS: dict[str, Part] = {"kills": kills, "stream": stream, "soak": soak, "malformed": malformed}


def main() -> None:
    """Run the tests, then print and write the tables. The exit code is 2 if a run fails unexpectedly."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: scripts/faults kills --kills 10 -o out/faults",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all without")
    parser.add_argument("-o", "--output", required=True, type=Path, help="folder of the runs and of faults.md")
    parser.add_argument("--kills", type=int, default=50, metavar="N", help="how many (default 50)")
    parser.add_argument("--frames", type=int, default=20_000, metavar="N", help="of the soak (default 20,000)")
    parser.add_argument(
        "--memory", type=float, metavar="GB", help="of the soak's map (mapping.memory; default no limit)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of all chance (default 0)")
    arguments = parser.parse_args()
    unknown = [part for part in arguments.parts if part not in PARTS]
    if unknown:
        parser.error(f"{unknown[0]} is none of {', '.join(PARTS)}")
    arguments.output = arguments.output.resolve()
    arguments.output.mkdir(parents=True, exist_ok=True)

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    try:
        tables = {part: PARTS[part](arguments, say) for part in arguments.parts or PARTS}
    except InputError as error:
        parser.exit(2, f"error: {error}\n")
    write_report(arguments.output, "faults", "\n\n".join(tables.values()), tables)


if __name__ == "__main__":
    main()

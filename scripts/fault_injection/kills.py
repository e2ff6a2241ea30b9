"""`kill -9` at random moments of a small run, which is resumed each time: the map must be the one of a run in peace."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fault_injection.runs import contents, finished, require_success, run_until

__all__ = ["KILLS_SCENE", "Kills", "kill_and_resume", "kills_table"]

# The demo room, so small that starting the process takes longest. Exposure is estimated and the tracker corrects its
# poses, so that everything that there is to be kept is at stake.
KILLS_SCENE = """\
source:  {scale: 0.25, holdout: 4, step: 3}
tracker: {kind: synthetic, drift: 0.05, correction: true, exposure_change: 0.5}
output:  reference
device:  cpu
mapping: {optimise: {steps: 4, last_steps: 6}, exposure: {enabled: true}}
refine:  {steps: 40}
export:  {report: false}
snapshot_every: 2
"""


@dataclass
class Kills:
    """moments: seconds after the start of its process at which each kill came. stages: how far the run was.

    runs: runs that came to their end, in spite of the kills on the way; identical: those whose files are the same as
    those of the run in peace. leftovers: half-written files that were found.
    """

    moments: list[float]
    stages: dict[str, int]
    runs: int = 0
    identical: int = 0
    leftovers: int = 0


def kill_and_resume(folder: Path, kills: int, seed: int, say: Callable[[str], None], scene: str = KILLS_SCENE) -> Kills:
    """Kill a run so many times; each is started again with `--resume` where it left a snapshot, else from its scene.

    A run that comes to its end is compared, and another one begun. Raises InputError where a run fails by itself.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    file = folder / "scene.yaml"
    file.write_text(scene, encoding="utf-8")
    peace = finished([str(file)], folder / "reference")
    expected = contents(folder / "reference")
    first = peace.first_snapshot or peace.seconds
    say(f"in peace: {peace.seconds:.1f} s, its first snapshot after {first:.1f} s")
    chance = random.Random(seed)
    result = Kills([], {"before the first snapshot": 0, "after one": 0})
    output = folder / "killed"
    under_way = False
    while len(result.moments) < kills or under_way:
        # One in four while it starts, which takes longest; the others once it maps, however busy the machine is.
        mapping = chance.random() > 0.25
        moment = chance.uniform(0.0, peace.seconds - first if mapping else first)
        snapshot = output / "snapshot.npz"
        kept = snapshot.is_file()
        arguments = ["--resume", str(output)] if kept else [str(file), "--set", f"output={json.dumps(str(output))}"]
        ended = run_until(arguments, snapshot, moment if len(result.moments) < kills else None, mapping)
        under_way = ended.killed
        if ended.killed:
            result.moments.append(ended.seconds)
            result.stages["after one" if snapshot.is_file() else "before the first snapshot"] += 1
            say(f"kill {len(result.moments)} of {kills} after {ended.seconds:.1f} s")
            continue
        require_success(ended, output)
        result.runs += 1
        result.identical += contents(output) == expected
        result.leftovers += len([*folder.glob("**/*.partial")]) + snapshot.exists()
        say(f"run {result.runs} has come to its end: {'identical' if contents(output) == expected else 'DIFFERENT'}")
        shutil.rmtree(output, ignore_errors=True)
    return result


def kills_table(result: Kills) -> str:
    """The result as Markdown."""
    stages = ", ".join(f"{count} {stage}" for stage, count in result.stages.items())
    lines = [
        "| kill -9 at random moments | |",
        "|---|---|",
        f"| kills | {len(result.moments)} ({stages}) |",
        f"| runs that came to their end after them | {result.runs} |",
        f"| of these with the same splats.ply and trajectory.txt, byte for byte | {result.identical} |",
        f"| half-written files left | {result.leftovers} |",
    ]
    return "\n".join(lines)

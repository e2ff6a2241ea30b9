"""Kills a small run at random moments and resumes it. The map must be identical to that of an undisturbed run."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.fault_injection.runs import contents, finished, require_success, run_until

__all__ = ["KILLS_SCENE", "Kills", "kill_and_resume", "kills_table"]

DEMO = Path(__file__).resolve().parents[2] / "demo" / "room.mp4"

# Part of the demo, so small that starting the process takes the most time. Exposure estimation is enabled, and `klt`
# corrects its poses, so that the snapshots contain all kinds of state.
KILLS_SCENE = f"""\
source:
  path: {json.dumps(str(DEMO))}
  intrinsics: {{fx: 512, cx: 320, cy: 240}}
  scale: 0.25
  holdout: 4
  step: 4
  stop: 104
tracker: {{kind: klt}}
output:  reference
device:  cpu
mapping: {{optimise: {{steps: 4}}, exposure: {{enabled: true}}}}
refine:  {{steps: 40}}
export:  {{report: false}}
snapshot_every: 2
"""


@dataclass
class Kills:
    """Result of the kills.

    Attributes:
        moments: Time of each kill since the start of its process [s].
        stages: Number of kills by stage of the run.
        runs: Number of runs that finished despite the kills.
        identical: Number of these whose files equal those of the undisturbed run.
        leftovers: Number of partial files found.
    """

    moments: list[float]
    stages: dict[str, int]
    runs: int = 0
    identical: int = 0
    leftovers: int = 0


def kill_and_resume(folder: Path, kills: int, seed: int, say: Callable[[str], None], scene: str = KILLS_SCENE) -> Kills:
    """Kill runs at random moments. Each continues with `--resume` if it left a snapshot, otherwise from its scene.

    When a run finishes, it is compared with the undisturbed run, and another one is started.

    Args:
        folder: Folder of the runs.
        kills: Number of kills.
        seed: Seed of the random moments.
        say: Called with progress lines.
        scene: Content of the scene file.

    Raises:
        InputError: If a run fails by itself.
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
        # A quarter of the kills hit the start, which takes longest. The others count from the first snapshot, so that
        # they hit the mapping even on a busy machine.
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
        temporary = [file for file in folder.glob("**/.modp-ti*/*") if file.name != "files.json"]
        result.leftovers += len([*folder.glob("**/*.partial"), *temporary]) + snapshot.exists()
        say(f"run {result.runs} has come to its end: {'identical' if contents(output) == expected else 'DIFFERENT'}")
        shutil.rmtree(output, ignore_errors=True)
    return result


def kills_table(result: Kills) -> str:
    """Return the result as a Markdown table."""
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

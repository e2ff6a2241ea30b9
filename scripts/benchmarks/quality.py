"""Held-out quality against processor time: runs of scenes at several budgets, by one version of the program or two."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from experiments import Job, run

from modp_ti.files.errors import InputError

__all__ = ["Point", "Program", "against", "curves", "frontier", "psnr_at", "seconds_to", "this_program"]

ROOT = Path(__file__).resolve().parents[2]
# Refinement steps per step of a keyframe, as in the default settings (1000 and 25).
REFINED = 40
# Stages of metrics.json that do not make the map.
NOT_MAPPING = ("compile", "evaluate")


@dataclass(frozen=True)
class Program:
    """A version of the program.

    Attributes:
        label: Commit, with `+` if the working tree differs from it.
        root: Checkout that it runs from.
    """

    label: str
    root: Path

    @property
    def keeps(self) -> bool:
        """Whether finished runs can be used again: those of a commit, but not those of a changed working tree."""
        return not self.label.endswith("+")

    @property
    def has_last_steps(self) -> bool:
        """Whether the last keyframe gets steps of its own, as up to 0.2.0. Later versions refuse the setting."""
        return "last_steps: int = Field(" in (self.root / "pipelines" / "settings.py").read_text(encoding="utf-8")


@dataclass(frozen=True)
class Point:
    """Quality of a map that one run has made.

    Attributes:
        steps: Optimisation steps of a keyframe.
        stage: "online" or "refined".
        seconds: Processor time from the first frame on, without compilation and scoring [s].
        psnr: Mean PSNR of the held-out frames [dB].
        ssim: Mean SSIM of the held-out frames.
        gaussians: Size of the map.
        view_renders: Views that were rendered and differentiated.
    """

    steps: int
    stage: str
    seconds: float
    psnr: float
    ssim: float
    gaussians: int
    view_renders: int


def this_program() -> Program:
    """Return the version of this checkout."""
    commit = _git("rev-parse", "--short", "HEAD")
    return Program(commit + ("+" if _git("status", "--porcelain", "--", "*.py", "*.toml") else ""), ROOT)


@contextmanager
def against(revision: str) -> Iterator[Program]:
    """Check a revision out into a temporary worktree.

    Args:
        revision: Commit, tag or branch.

    Yields:
        The program of that revision.

    Raises:
        InputError: If git does not know the revision.
    """
    commit = _git("rev-parse", "--short", "--verify", "--quiet", revision + "^{commit}")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "worktree"
        _git("worktree", "add", "--detach", str(root), commit)
        try:
            yield Program(commit, root)
        finally:
            _git("worktree", "remove", "--force", str(root))


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        why = done.stderr.strip() or "no such revision"
        raise InputError(f"git {' '.join(arguments)}: {why}; --quality needs a git checkout")
    return done.stdout.strip()


def curves(
    scenes: Mapping[str, Path],
    programs: Mapping[Program, Sequence[int]],
    repeats: int,
    settings: Mapping[str, str],
    folder: Path,
) -> dict[str, dict[str, list[Point]]]:
    """Run every scene with every program at each of its budgets, interleaved, so that all see the same machine.

    Args:
        scenes: Scene files by name.
        programs: Versions of the program, each with its budgets: optimisation steps of a keyframe, a run for each.
        repeats: Runs of each, whose median processor time counts. The maps of one program are identical.
        settings: Overrides by key.
        folder: Keeps the points of finished runs of commits, which are not run again.

    Returns:
        Points by scene and program, by increasing budget.

    Raises:
        InputError: If a run fails.
    """
    result: dict[str, dict[str, list[Point]]] = {name: {p.label: [] for p in programs} for name in scenes}
    for name, scene in scenes.items():
        for steps in sorted(set().union(*programs.values())):
            due = [program for program, budgets in programs.items() if steps in budgets]
            runs: dict[str, list[list[Point]]] = {p.label: [] for p in due}
            for repeat in range(repeats):
                for program in due if repeat % 2 == 0 else due[::-1]:
                    kept = folder / program.label / f"{name}-{steps}-{repeat}.json"
                    print(f"{name}, {steps} steps a keyframe, {program.label} ...", file=sys.stderr, flush=True)
                    runs[program.label].append(_points(program, scene, steps, settings, kept))
            for label, of in runs.items():
                result[name][label] += [_median(list(same)) for same in zip(*of, strict=True)]
    return result


def _points(program: Program, scene: Path, steps: int, settings: Mapping[str, str], kept: Path) -> list[Point]:
    """Return the points of a run, from the file `kept` if an earlier one with the same settings wrote it."""
    overrides = {
        "threads": "1",
        "mapping.optimise.steps": str(steps),
        "refine.steps": str(REFINED * steps),
        "export.report": "false",
        **settings,
    }
    if program.has_last_steps:
        overrides["mapping.optimise.last_steps"] = str(steps)
    if program.keeps and kept.is_file():
        record = json.loads(kept.read_text(encoding="utf-8"))
        if record["scene"] == scene.read_text(encoding="utf-8") and record["overrides"] == overrides:
            return [Point(**point) for point in record["points"]]
    with tempfile.TemporaryDirectory() as folder:
        job = Job(f"the run of {scene} by {program.label}", scene, Path(folder) / "out", overrides)
        seconds = _run(program, job)
        points = points_of(job.metrics(), seconds, steps)
    kept.parent.mkdir(parents=True, exist_ok=True)
    record = {"scene": scene.read_text(encoding="utf-8"), "overrides": overrides, "points": [asdict(p) for p in points]}
    kept.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    return points


def _run(program: Program, job: Job) -> float:
    """Run a job and return the processor time of the process [s]."""
    before = os.times()
    # The module is found in the working folder, before the installed package.
    code = run(job, cwd=program.root, env=os.environ | {"PYTHONPATH": str(program.root)})
    after = os.times()
    if code:
        raise InputError(f"{job.label} ended with exit code {code}")
    return after.children_user + after.children_system - before.children_user - before.children_system


def points_of(metrics: Mapping[str, Any], processor: float, steps: int) -> list[Point]:
    """Return the points of a run.

    metrics.json holds the elapsed time of every stage. The processor time is divided in the same proportions.

    Args:
        metrics: Content of metrics.json.
        processor: Processor time of the whole run [s].
        steps: Optimisation steps of a keyframe.
    """
    seconds = metrics["seconds"]
    all_stages = seconds["total"] - sum(seconds.get(stage, 0.0) for stage in NOT_MAPPING)
    shares = {"online": all_stages - seconds.get("refine", 0.0), "refined": all_stages}
    points = []
    for stage, share in shares.items():
        if (scores := metrics[stage]) is not None:
            psnr, ssim = scores["held_out"]["psnr"], scores["held_out"]["ssim"]
            made_of = scores["gaussians"], scores["view_renders"]
            points.append(Point(steps, stage, processor * share / seconds["total"], psnr, ssim, *made_of))
    return points


def _median(same: Sequence[Point]) -> Point:
    """Return the point with the median processor time."""
    return sorted(same, key=lambda point: point.seconds)[len(same) // 2]


def frontier(points: Sequence[Point]) -> list[tuple[float, float]]:
    """Return (seconds, PSNR) of the points that no other one beats in both, by increasing time."""
    best: list[tuple[float, float]] = []
    for seconds, psnr in sorted((point.seconds, point.psnr) for point in points):
        if not best or psnr > best[-1][1]:
            best.append((seconds, psnr))
    return best


def psnr_at(points: Sequence[Point], seconds: float) -> float | None:
    """Return the PSNR that a time reaches [dB]: the frontier, interpolated over the logarithm of time.

    Args:
        points: Points of one scene and program.
        seconds: Processor time [s].

    Returns:
        The PSNR, that of the best point beyond the last one, None before the first.
    """
    times, values = zip(*frontier(points), strict=True)
    return None if seconds < times[0] else float(np.interp(np.log(seconds), np.log(times), values))


def seconds_to(points: Sequence[Point], psnr: float) -> float | None:
    """Return the processor time that reaches a PSNR [s], as `psnr_at` reads the frontier; None if none does."""
    times, values = zip(*frontier(points), strict=True)
    return None if psnr > values[-1] else float(np.exp(np.interp(psnr, values, np.log(times))))

"""Held-out quality against processor time: runs of scenes at several budgets, by one version of the program or two."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tables import Figures, mapping_seconds, markdown_table

from modp_ti.files.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
# Refinement steps per step of a keyframe, as in the default settings (1000 and 25).
REFINED = 40
# Stages of metrics.json that do not make the map.
NOT_MAPPING = ("compile", "evaluate")
MINUTES = (0.5, 1, 2, 4, 8, 16)
POINTS = {
    "PSNR": ("psnr", ".2f"),
    "SSIM": ("ssim", ".3f"),
    "Gaussians": ("gaussians", ",.0f"),
    "view renders": ("view_renders", ",.0f"),
    "processor [s]": ("seconds", ",.1f"),
}


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


Curves = Mapping[str, Mapping[str, Sequence[Point]]]
"""Points by scene and program."""


def this_program() -> tuple[str, Path]:
    """Return the commit of this checkout, with `+` if the working tree differs from it, and its folder."""
    changed = _git("status", "--porcelain", "--", "*.py", "*.toml")
    return _git("rev-parse", "--short", "HEAD") + ("+" if changed else ""), ROOT


@contextmanager
def against(revision: str) -> Iterator[tuple[str, Path]]:
    """Yield another commit, as `this_program` names it, checked out into a temporary worktree.

    Raises:
        InputError: If git does not know the revision.
    """
    commit = _git("rev-parse", "--short", "--verify", "--quiet", revision + "^{commit}")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "worktree"
        _git("worktree", "add", "--detach", str(root), commit)
        try:
            yield commit, root
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
    programs: Mapping[tuple[str, Path], Sequence[int]],
    repeats: int,
    settings: Mapping[str, Any],
) -> dict[str, dict[str, list[Point]]]:
    """Run every scene with every program at each of its budgets, interleaved, so that all see the same machine.

    Args:
        scenes: Scene files by name.
        programs: Commits and their folders, each with its budgets: optimisation steps of a keyframe, a run for each.
        repeats: Runs of each, whose median processor time counts. The maps of one program are identical.
        settings: Overrides by key.

    Returns:
        Points by scene and program, by increasing budget.

    Raises:
        InputError: If a run fails.
    """
    result: dict[str, dict[str, list[Point]]] = {name: {label: [] for label, _ in programs} for name in scenes}
    for name, scene in scenes.items():
        for steps in sorted(set().union(*programs.values())):
            due = [program for program, budgets in programs.items() if steps in budgets]
            runs: dict[str, list[list[Point]]] = {label: [] for label, _ in due}
            for repeat in range(repeats):
                for label, root in due if repeat % 2 == 0 else due[::-1]:
                    print(f"{name}, {steps} steps a keyframe, {label} ...", file=sys.stderr, flush=True)
                    runs[label].append(_measured(root, scene, steps, settings))
            for label, of in runs.items():
                result[name][label] += [
                    sorted(same, key=lambda point: point.seconds)[len(same) // 2] for same in zip(*of, strict=True)
                ]
    return result


def _measured(root: Path, scene: Path, steps: int, settings: Mapping[str, Any]) -> list[Point]:
    """Run a scene with the program of a folder, and return its points."""
    with tempfile.TemporaryDirectory() as folder:
        overrides = {
            "threads": 1,
            "mapping.optimise.steps": steps,
            "refine.steps": REFINED * steps,
            "export.report": "false",
            **settings,
            "output": json.dumps(folder),
        }
        command = [sys.executable, "-m", "modp_ti.run", str(scene)]
        for key, value in overrides.items():
            command += ["--set", f"{key}={value}"]
        before = os.times()
        # The module is found in the working folder, before the installed package.
        environment = os.environ | {"PYTHONPATH": str(root)}
        done = subprocess.run(command, stdout=sys.stderr, check=False, cwd=root, env=environment)
        after = os.times()
        if done.returncode:
            raise InputError(f"the run of {scene} ended with exit code {done.returncode}")
        processor = after.children_user + after.children_system - before.children_user - before.children_system
        return points_of(json.loads((Path(folder) / "metrics.json").read_text("utf-8")), processor, steps)


def points_of(metrics: Mapping[str, Any], processor: float, steps: int) -> list[Point]:
    """Return the points of a run.

    metrics.json holds the elapsed time of every stage. The processor time is divided in the same proportions.

    Args:
        metrics: Content of metrics.json.
        processor: Processor time of the whole run [s].
        steps: Optimisation steps of a keyframe.
    """
    points = []
    for stage in ("online", "refined"):
        if (scores := metrics[stage]) is not None:
            seconds = mapping_seconds(metrics, stage == "refined", NOT_MAPPING)
            seconds = processor * seconds / metrics["seconds"]["total"]
            psnr, ssim = scores["held_out"]["psnr"], scores["held_out"]["ssim"]
            points.append(Point(steps, stage, seconds, psnr, ssim, scores["gaussians"], scores["view_renders"]))
    return points


# ---- tables ----------------------------------------------------------------------------------------------------------


def frontier(points: Sequence[Point]) -> list[tuple[float, float]]:
    """Return (seconds, PSNR) of the points that no other one beats in both, by increasing time."""
    best: list[tuple[float, float]] = []
    for seconds, psnr in sorted((point.seconds, point.psnr) for point in points):
        if not best or psnr > best[-1][1]:
            best.append((seconds, psnr))
    return best


def psnr_at(points: Sequence[Point], seconds: float) -> float | None:
    """Return the PSNR that a time [s] reaches: the frontier, interpolated over the logarithm of time.

    It is that of the best point beyond the last one, and None before the first.
    """
    times, values = zip(*frontier(points), strict=True)
    return None if seconds < times[0] else float(np.interp(np.log(seconds), np.log(times), values))


def seconds_to(points: Sequence[Point], psnr: float) -> float | None:
    """Return the processor time that reaches a PSNR [s], as `psnr_at` reads the frontier; None if none does."""
    times, values = zip(*frontier(points), strict=True)
    return None if psnr > values[-1] else float(np.exp(np.interp(psnr, values, np.log(times))))


def report(curves: Curves) -> str:
    """Return the tables: quality per minute, time for equal quality with two programs, and all points."""
    parts = [
        "# Quality per minute",
        "Held-out PSNR [dB] after so many minutes of processor time on one thread, from the first frame on, without "
        "compilation and scoring: the best of the online and the refined maps of all budgets, interpolated.",
    ]
    columns = {f"{minutes:g} min": (f"{minutes:g}", ".2f") for minutes in MINUTES}
    rows: dict[str, Figures] = {
        f"{scene}, {program}": {f"{minutes:g}": psnr_at(points, 60 * minutes) for minutes in MINUTES}
        for scene, of in curves.items()
        for program, points in of.items()
    }
    parts.append(markdown_table("scene, program", columns, rows))
    if all(len(of) == 2 for of in curves.values()):
        parts += ["## Time for the same quality", _equal_quality(curves)]
    for scene, of in curves.items():
        points = {f"{label}, {p.steps}, {p.stage}": vars(p) for label, points in of.items() for p in points}
        parts += [f"## {scene}", markdown_table("program, steps a keyframe, map", POINTS, points)]
    return "\n\n".join(parts)


def _equal_quality(curves: Curves) -> str:
    """Return the table of the share of the second program's time in which the first one reaches the same PSNR."""
    rows: dict[str, Figures] = {}
    for scene, of in curves.items():
        new, old = of.values()
        for point in old:
            comparable = [other for other in new if other.stage == point.stage]
            seconds = seconds_to(comparable, point.psnr) if comparable else None
            rows[f"{scene}, {point.stage}, {point.steps} steps"] = {
                "psnr": point.psnr,
                "old": point.seconds,
                "new": seconds,
                "share": None if seconds is None else 100 * seconds / point.seconds,
            }
    first, second = next(iter(curves.values()))
    columns = {
        "PSNR": ("psnr", ".2f"),
        f"{second} [s]": ("old", ",.0f"),
        f"{first} [s]": ("new", ",.0f"),
        "share [%]": ("share", ".0f"),
    }
    return markdown_table(f"as {second} reaches it", columns, rows)


def plot(curves: Curves, file: Path) -> None:
    """Write a PNG with PSNR over processor time, a panel for each scene."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(curves), 3.6), layout="constrained")
    for axes, (scene, of) in zip(figure.subplots(1, len(curves), squeeze=False)[0], curves.items(), strict=True):
        for colour, (program, points) in enumerate(of.items()):
            for stage, line in (("online", "o-"), ("refined", "s--")):
                shown = [point for point in points if point.stage == stage]
                style = {"color": f"C{colour}", "ms": 4, "label": f"{program}, {stage}"}
                axes.plot([p.seconds for p in shown], [p.psnr for p in shown], line, **style)
        axes.set(xscale="log", title=scene, xlabel="processor time [s]", ylabel="held-out PSNR [dB]")
        axes.grid(alpha=0.3, which="both")
    figure.axes[0].legend(fontsize="small")
    figure.savefig(file, dpi=110)

"""Held-out quality against time: runs of scenes at several budgets, by one version of the program or two."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tables import Figures, mapping_seconds, markdown_table, quality
from versions import ROOT

from modp_ti.files.errors import InputError

# Refinement steps per step of a keyframe, as in the default settings (1000 and 25).
REFINED = 40
# Stages of metrics.json that do not make the map.
NOT_MAPPING = ("compile", "evaluate")
MINUTES = (0.5, 1, 2, 4, 8, 16)
POINTS = {
    "PSNR": ("psnr", ".2f"),
    "SSIM": ("ssim", ".3f"),
    "detail": ("detail", ".3f"),
    "PSNR, fitted": ("fitted", ".2f"),
    "worst 20 retained": ("retained", ".2f"),
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
        detail: Their detail, see `explained_detail`; None for versions before it.
        fitted: Mean PSNR of the frames that the map was optimised on [dB]; None for versions before it.
        retained: PSNR less that just after their own steps, in the worst 20 keyframes in a row [dB].
        gaussians: Size of the map.
        view_renders: Views that were rendered and differentiated.
    """

    steps: int
    stage: str
    seconds: float
    psnr: float
    ssim: float
    detail: float | None
    fitted: float | None
    retained: float | None
    gaussians: int
    view_renders: int


Curves = Mapping[str, Mapping[str, Sequence[Point]]]
"""Points by scene and version."""


def curves(
    scenes: Mapping[str, Path],
    versions: Mapping[str, Path],
    budgets: Sequence[int],
    repeats: int,
    settings: Mapping[str, Any],
) -> dict[str, dict[str, list[Point]]]:
    """Run every scene with every version at each budget, interleaved, so that all see the same machine.

    Args:
        scenes: Scene files by name.
        versions: Folders by commit.
        budgets: Optimisation steps of a keyframe, a run for each.
        repeats: Runs of each, whose median processor time counts. The maps of one version are identical.
        settings: Overrides by key.

    Returns:
        Points by scene and version, by increasing budget.

    Raises:
        InputError: If a run fails.
    """
    result: dict[str, dict[str, list[Point]]] = {name: {commit: [] for commit in versions} for name in scenes}
    for name, scene in scenes.items():
        for steps in sorted(budgets):
            runs: dict[str, list[list[Point]]] = {commit: [] for commit in versions}
            for repeat in range(repeats):
                for commit in list(versions)[:: 1 if repeat % 2 == 0 else -1]:
                    print(f"{name}, {steps} steps a keyframe, {commit} ...", file=sys.stderr, flush=True)
                    runs[commit].append(measured(versions[commit], scene, steps, settings))
            for commit, of in runs.items():
                for same in zip(*of, strict=True):
                    result[name][commit].append(sorted(same, key=lambda point: point.seconds)[len(same) // 2])
    return result


def measured(root: Path, scene: Path, steps: int, settings: Mapping[str, Any]) -> list[Point]:
    """Run a scene with the version in a folder, and return its points."""
    fixed = {"threads": 1, "mapping.optimise.steps": steps, "refine.steps": REFINED * steps}
    return points_of(*_run(root, scene, {**fixed, **settings}), steps)


def _run(root: Path, scene: Path, settings: Mapping[str, Any]) -> tuple[dict[str, Any], float]:
    """Run a scene with the version in a folder. Returns the content of metrics.json, and the processor time [s]."""
    with tempfile.TemporaryDirectory() as folder:
        overrides = {"export.report": "false", **settings, "output": json.dumps(folder)}
        command = [sys.executable, "-m", "modp_ti.run", str(scene)]
        command += [part for key, value in overrides.items() for part in ("--set", f"{key}={value}")]
        before = os.times()
        # The module is found in the working folder, before the installed package.
        environment = os.environ | {"PYTHONPATH": str(root)}
        done = subprocess.run(command, stdout=sys.stderr, check=False, cwd=root, env=environment)
        after = os.times()
        if done.returncode:
            raise InputError(f"the run of {scene} ended with exit code {done.returncode}")
        processor = after.children_user + after.children_system - before.children_user - before.children_system
        return json.loads((Path(folder) / "metrics.json").read_text("utf-8")), processor


Timed = Mapping[str, Mapping[float, Mapping[str, float | None]]]
"""PSNR [dB] and seconds from the start to the saved map, of runs by scene and minutes."""


def timed(scenes: Mapping[str, Path], minutes: Sequence[float], settings: Mapping[str, Any]) -> Timed:
    """Run every scene for so many minutes each, on all cores. Raises InputError if a run fails."""
    result: dict[str, dict[float, Mapping[str, float | None]]] = {name: {} for name in scenes}
    for name, scene in scenes.items():
        for given in sorted(minutes):
            print(f"{name}, {given:g} minutes ...", file=sys.stderr, flush=True)
            metrics, _ = _run(ROOT, scene, {**settings, "minutes": given})
            scores = quality(metrics["refined"] or metrics["online"])
            result[name][given] = {"psnr": scores["psnr"], "seconds": metrics["timed"]["seconds_to_map"]}
    return result


def timed_report(runs: Timed) -> str:
    """Return the table of `timed`."""
    minutes = sorted({given for of in runs.values() for given in of})
    late = max((of["seconds"] or 0.0) - 60.0 * given for by in runs.values() for given, of in by.items())
    rows = {scene: {f"{given:g}": of["psnr"] for given, of in by.items()} for scene, by in runs.items()}
    return "\n\n".join(
        (
            "# Quality after a given time",
            "PSNR [dB] of `modp-ti run --minutes`, of the held-out frames, or of all where none is held out. The last "
            f"map was in its folder {late:+.1f} s from its time.",
            markdown_table("scene", {f"{given:g} min": (f"{given:g}", ".2f") for given in minutes}, rows),
        )
    )


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
            of, fitted = scores["held_out"], scores.get("fitted", {}).get("psnr")
            retained = (metrics.get("retention") or {}).get(stage, {}).get("worst")
            values = of["psnr"], of["ssim"], of.get("detail"), fitted, retained
            points.append(Point(steps, stage, seconds, *values, scores["gaussians"], scores["view_renders"]))
    return points


def frontier(points: Sequence[Point]) -> tuple[list[float], list[float]]:
    """Return the times [s] and PSNRs of the points that no other one beats in both, by increasing time."""
    best: list[tuple[float, float]] = []
    for seconds, psnr in sorted((point.seconds, point.psnr) for point in points):
        if not best or psnr > best[-1][1]:
            best.append((seconds, psnr))
    return [seconds for seconds, _ in best], [psnr for _, psnr in best]


def psnr_at(points: Sequence[Point], seconds: float) -> float | None:
    """Return the PSNR that a time [s] reaches: the frontier, interpolated over the logarithm of time.

    It is that of the best point beyond the last one, and None before the first.
    """
    times, values = frontier(points)
    return None if seconds < times[0] else float(np.interp(np.log(seconds), np.log(times), values))


def seconds_to(points: Sequence[Point], psnr: float) -> float | None:
    """Return the processor time that reaches a PSNR [s], as `psnr_at` reads the frontier; None if none does."""
    times, values = frontier(points)
    return None if psnr > values[-1] else float(np.exp(np.interp(psnr, values, np.log(times))))


def report(curves: Curves) -> str:
    """Return the tables: quality per minute, time for equal quality with two versions, and all points."""
    parts = [
        "# Quality per minute",
        "Held-out PSNR [dB] after so many minutes of processor time on one thread, from the first frame on, without "
        "compilation and scoring: the best of the online and the refined maps of all budgets, interpolated.",
    ]
    columns = {f"{minutes:g} min": (f"{minutes:g}", ".2f") for minutes in MINUTES}
    rows: dict[str, Figures] = {
        f"{scene}, {version}": {f"{minutes:g}": psnr_at(points, 60 * minutes) for minutes in MINUTES}
        for scene, of in curves.items()
        for version, points in of.items()
    }
    parts.append(markdown_table("scene, version", columns, rows))
    if all(len(of) == 2 for of in curves.values()):
        parts += ["## Time for the same quality", _equal_quality(curves)]
    for scene, of in curves.items():
        points = {f"{version}, {p.steps}, {p.stage}": vars(p) for version, points in of.items() for p in points}
        parts += [f"## {scene}", markdown_table("version, steps a keyframe, map", POINTS, points)]
    return "\n\n".join(parts)


def _equal_quality(curves: Curves) -> str:
    """Return the table of the share of the second version's time in which the first one reaches the same PSNR."""
    rows: dict[str, Figures] = {}
    for scene, of in curves.items():
        new, old = of.values()
        for point in old:
            seconds = seconds_to([other for other in new if other.stage == point.stage], point.psnr)
            share = None if seconds is None else 100 * seconds / point.seconds
            figures = {"psnr": point.psnr, "old": point.seconds, "new": seconds, "share": share}
            rows[f"{scene}, {point.stage}, {point.steps} steps"] = figures
    first, second = next(iter(curves.values()))
    columns = {"PSNR": ("psnr", ".2f"), f"{second} [s]": ("old", ",.0f"), f"{first} [s]": ("new", ",.0f")}
    return markdown_table(f"as {second} reaches it", columns | {"share [%]": ("share", ".0f")}, rows)

"""Runs of a scene with several settings, kept on disk, and their figures as Markdown: for ablate.py and compare.py."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError

__all__ = [
    "Figures",
    "Job",
    "command_line",
    "execute",
    "first_third_psnr",
    "load_metrics",
    "mapping_seconds",
    "markdown_table",
    "mean_figures",
    "named_scenes",
    "quality",
    "write_report",
]

# What one row of a table shows, by the names in its columns; None where a run does not have it.
Figures = Mapping[str, float | None]
# Seconds of metrics.json that are no mapping: they do not depend on the method.
NOT_MAPPING = ("compile", "track", "evaluate")


@dataclass(frozen=True)
class Job:
    """One run: a scene file, settings over it as {key: YAML text}, and the folder of its results."""

    label: str
    scene: Path
    folder: Path
    overrides: Mapping[str, str]

    def arguments(self) -> list[str]:
        """The overrides as the command line takes them, the output folder among them."""
        # A JSON text is a YAML text too, whatever stands in the path.
        return [f"{key}={value}" for key, value in self.overrides.items()] + [
            f"output={json.dumps(str(self.folder.resolve()))}"
        ]

    def check(self) -> dict[str, Any]:
        """The resolved settings of the run; raises InputError where the scene does not take them."""
        return load_scene(self.scene, self.arguments()).model_dump(mode="json")

    def is_done(self) -> bool:
        """Whether the folder holds the results of a run with these very settings."""
        written = self.folder / "config.yaml"
        if not written.is_file() or not (self.folder / "metrics.json").is_file():
            return False
        try:
            return load_scene(written).model_dump(mode="json") == self.check()
        except InputError:  # written by another version
            return False


def named_scenes(files: Iterable[str]) -> dict[str, Path]:
    """Scene files by short names: that of the file, or of its folder for one called `scene.yaml`."""
    scenes: dict[str, Path] = {}
    for text in files:
        file = Path(text).resolve()
        name = file.parent.name if file.stem == "scene" else file.stem
        if name in scenes:
            raise InputError(f"{text}: a scene called {name} is there already: {scenes[name]}; rename one file")
        scenes[name] = file
    return scenes


def command_line(settings: Iterable[str]) -> dict[str, str]:
    """`--set key=value` texts as overrides; later ones win."""
    overrides = {}
    for text in settings:
        key, equals, value = text.partition("=")
        if not equals:
            raise InputError(f"--set {text}: write it as section.key=value, for example source.scale=0.5")
        overrides[key.strip()] = value
    return overrides


def execute(jobs: Sequence[Job], fresh: bool = False, say: Callable[[str], None] | None = None) -> list[dict[str, Any]]:
    """The metrics of every job, those run that are not there yet, one after the other, each in a process of its own.

    fresh: run all of them. Raises InputError before the first run where one has impossible settings, and where a run
    fails; the finished ones are kept.
    """
    say = say or (lambda text: print(text, file=sys.stderr, flush=True))
    for job in jobs:
        job.check()
    for number, job in enumerate(jobs, 1):
        done = not fresh and job.is_done()
        say(f"[{number}/{len(jobs)}] {job.label}{': already there (--fresh runs it again)' if done else ''}")
        if not done:
            _run(job)
    return [load_metrics(job.folder) for job in jobs]


def _run(job: Job) -> None:
    command = [sys.executable, "-m", "modp_ti.run", str(job.scene)]
    for argument in job.arguments():
        command += ["--set", argument]
    # To the terminal, but not into the Markdown: that alone is the output.
    code = subprocess.run(command, stdout=sys.stderr, check=False).returncode
    if code:
        raise InputError(
            f"{job.label}: the run ended with exit code {code}; start again to go on, finished runs are kept"
        )


def load_metrics(folder: Path) -> dict[str, Any]:
    """metrics.json of a run's folder."""
    return json.loads((folder / "metrics.json").read_text(encoding="utf-8"))


def quality(section: Mapping[str, Any]) -> dict[str, float | None]:
    """psnr, ssim, lpips of a section of metrics.json: of the held-out frames, or of all where none is held out."""
    scores = section["held_out"] if section["held_out"]["count"] else section["all"]
    return {name: scores[name] for name in ("psnr", "ssim", "lpips")}


def mapping_seconds(metrics: Mapping[str, Any], refined: bool) -> float:
    """Seconds of a run without compiling, the tracker's preparation and evaluation; with refinement where asked."""
    seconds = metrics["seconds"]
    left_out = sum(seconds.get(stage, 0.0) for stage in NOT_MAPPING)
    return seconds["total"] - left_out - (0.0 if refined else seconds.get("refine", 0.0))


def first_third_psnr(folder: Path, stage: str) -> float | None:
    """Mean PSNR of the held-out frames (all where none is) among the first third of the frames, from scores.csv."""
    file = folder / "scores.csv"
    if not file.is_file():
        return None
    with file.open(encoding="utf-8", newline="") as lines:
        rows = sorted(
            (row for row in csv.DictReader(lines) if row["stage"] == stage), key=lambda row: int(row["index"])
        )
    some_held_out = any(row["held_out"] == "1" for row in rows)
    early = rows[: -(-len(rows) // 3)]
    scores = [float(row["psnr"]) for row in early if row["held_out"] == "1" or not some_held_out]
    return sum(scores) / len(scores) if scores else None


def mean_figures(scenes: Sequence[Figures]) -> Figures:
    """The mean of every figure over the scenes; None where a scene does not have it."""
    result: dict[str, float | None] = {}
    for name in scenes[0]:
        values = [figures[name] for figures in scenes]
        known = [value for value in values if value is not None]
        result[name] = sum(known) / len(known) if len(known) == len(values) else None
    return result


def markdown_table(corner: str, columns: Mapping[str, tuple[str, str]], rows: Mapping[str, Figures]) -> str:
    """A table; columns: {header: (name of the figure, format)}. A figure that is None shows as a dash."""
    lines = [f"| {corner} | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for label, figures in rows.items():
        cells = [label]
        for name, form in columns.values():
            value = figures.get(name)
            cells.append("–" if value is None else format(value, form))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def write_report(folder: Path, name: str, text: str, figures: Any) -> None:
    """NAME.md and NAME.json in the folder; the Markdown is printed too."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.md").write_text(text + "\n", encoding="utf-8")
    (folder / f"{name}.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    print(text)

"""Runs scenes with several settings, keeps the results on disk and formats their figures.

Used by ablate.py and compare.py.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.scores_csv import read_scores

# Figures of one table row by name; None if a run does not have the figure.
Figures = Mapping[str, float | None]
# Stages of metrics.json that are not mapping and do not depend on the method.
NOT_MAPPING = ("compile", "track", "evaluate")


@dataclass(frozen=True)
class Job:
    """One run.

    Attributes:
        label: Name for messages.
        scene: Scene file.
        folder: Output folder.
        overrides: Settings as {key: YAML text}.
    """

    label: str
    scene: Path
    folder: Path
    overrides: Mapping[str, str]

    def arguments(self) -> list[str]:
        """Return the overrides, including the output folder, as `key=value` arguments."""
        # JSON is valid YAML, whatever characters the path contains.
        overrides = {**self.overrides, "output": json.dumps(str(self.folder.resolve()))}
        return [f"{key}={value}" for key, value in overrides.items()]

    def check(self) -> dict[str, Any]:
        """Return the run's resolved settings. Raises InputError if they are not valid."""
        return load_scene(self.scene, self.arguments()).model_dump(mode="json")

    def is_done(self) -> bool:
        """Return whether the folder holds the results of a run with exactly these settings."""
        written = self.folder / "config.yaml"
        if not written.is_file() or not (self.folder / "metrics.json").is_file():
            return False
        try:
            return load_scene(written).model_dump(mode="json") == self.check()
        except InputError:  # from an incompatible version
            return False

    def metrics(self) -> dict[str, Any]:
        """Read metrics.json of the finished run."""
        return json.loads((self.folder / "metrics.json").read_text(encoding="utf-8"))


def parser(description: str | None, example: str) -> argparse.ArgumentParser:
    """Return a command line parser that keeps the lines of the description, with the option `--set`."""
    result = argparse.ArgumentParser(
        description=description,
        epilog=f"example: {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of every run")
    return result


def experiment_parser(description: str | None, example: str) -> argparse.ArgumentParser:
    """Return a parser of scenes, output folder, `--set` and `--fresh`."""
    result = parser(description, example)
    result.add_argument("scenes", nargs="+", metavar="scene.yaml", help="scene files, one or several")
    result.add_argument("-o", "--output", required=True, type=Path, help="folder of the runs and of the tables")
    result.add_argument("--fresh", action="store_true", help="repeat finished runs")
    return result


def named_scenes(files: Iterable[str]) -> dict[str, Path]:
    """Return the scene files by name, which is the file's, or the folder's if the file is called `scene.yaml`."""
    scenes: dict[str, Path] = {}
    for text in files:
        file = Path(text).resolve()
        name = file.parent.name if file.stem == "scene" else file.stem
        if name in scenes:
            raise InputError(f"{text}: a scene called {name} is there already: {scenes[name]}; rename one file")
        scenes[name] = file
    return scenes


def command_line(settings: Iterable[str]) -> dict[str, str]:
    """Parse `key=value` texts of `--set` into overrides. Later ones win."""
    overrides = {}
    for text in settings:
        key, equals, value = text.partition("=")
        if not equals:
            raise InputError(f"--set {text}: write it as section.key=value, for example source.scale=0.5")
        overrides[key.strip()] = value
    return overrides


def execute(jobs: Sequence[Job], fresh: bool = False, say: Callable[[str], None] | None = None) -> list[dict[str, Any]]:
    """Run the jobs that are not done, one after the other in their own processes, and return the metrics of all.

    Args:
        jobs: The jobs.
        fresh: Run all of them, even if they are done.
        say: Called with progress lines, None to print them to standard error.

    Raises:
        InputError: If a job has invalid settings (checked before the first run), or a run fails. Finished runs are
            kept.
    """
    say = say or (lambda text: print(text, file=sys.stderr, flush=True))
    for job in jobs:
        job.check()
    for number, job in enumerate(jobs, 1):
        done = not fresh and job.is_done()
        say(f"[{number}/{len(jobs)}] {job.label}{': already there (--fresh runs it again)' if done else ''}")
        if not done and (code := run(job)):
            raise InputError(
                f"{job.label}: the run ended with exit code {code}; start again to go on, finished runs are kept"
            )
    return [job.metrics() for job in jobs]


def run(job: Job, **options: Any) -> int:
    """Run a job in its own process, with options of `subprocess.run`, and return the exit code."""
    command = [sys.executable, "-m", "modp_ti.run", str(job.scene)]
    for argument in job.arguments():
        command += ["--set", argument]
    # Standard output carries only the Markdown.
    return subprocess.run(command, stdout=sys.stderr, check=False, **options).returncode


def quality(section: Mapping[str, Any]) -> dict[str, float | None]:
    """Return psnr, ssim and lpips of a section of metrics.json: of the held-out frames, or of all if there are none."""
    scores = section["held_out"] if section["held_out"]["count"] else section["all"]
    return {name: scores[name] for name in ("psnr", "ssim", "lpips")}


def mapping_seconds(metrics: Mapping[str, Any], refined: bool) -> float:
    """Return a run's time [s] without compiling, the tracker's preparation and evaluation.

    Args:
        metrics: Content of metrics.json.
        refined: Whether to include the post refinement.
    """
    seconds = metrics["seconds"]
    left_out = sum(seconds.get(stage, 0.0) for stage in NOT_MAPPING)
    return seconds["total"] - left_out - (0.0 if refined else seconds.get("refine", 0.0))


def first_third_psnr(folder: Path, stage: str) -> float | None:
    """Return the mean PSNR over the first third of the frames from scores.csv.

    It covers the held-out frames, or all if there are none. None if the file does not exist.
    """
    file = folder / "scores.csv"
    if not file.is_file():
        return None
    scores = sorted((score for score in read_scores(file) if score.stage == stage), key=lambda score: score.index)
    some_held_out = any(score.held_out for score in scores)
    early = scores[: -(-len(scores) // 3)]
    counted = [score.psnr for score in early if score.held_out or not some_held_out]
    return statistics.fmean(counted) if counted else None


def mean_figures(scenes: Sequence[Figures]) -> Figures:
    """Return the mean of every figure over the scenes, None if a scene lacks it."""
    result: dict[str, float | None] = {}
    for name in scenes[0]:
        known = [value for figures in scenes if (value := figures[name]) is not None]
        result[name] = statistics.fmean(known) if len(known) == len(scenes) else None
    return result


def with_mean(figures: Mapping[str, Mapping[str, Figures]]) -> dict[str, Mapping[str, Figures]]:
    """Return the rows of every scene by title; with several scenes, the mean of their common rows comes first."""
    if len(figures) < 2:
        return dict(figures)
    first, *others = figures.values()
    labels = [label for label in first if all(label in rows for rows in others)]
    mean = {label: mean_figures([rows[label] for rows in figures.values()]) for label in labels}
    return {f"Mean of {len(figures)} scenes": mean, **figures}


def markdown_table(corner: str, columns: Mapping[str, tuple[str, str]], rows: Mapping[str, Figures]) -> str:
    """Return a Markdown table. Missing figures appear as a dash.

    Args:
        corner: Header of the first column.
        columns: {header: (name of the figure, format)}.
        rows: Figures by label.
    """
    lines = [f"| {corner} | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for label, figures in rows.items():
        cells = [label]
        for name, form in columns.values():
            value = figures.get(name)
            cells.append("–" if value is None else format(value, form))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def write_report(folder: Path, name: str, text: str, figures: Any) -> None:
    """Print the Markdown text, and write NAME.md and NAME.json to the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.md").write_text(text + "\n", encoding="utf-8")
    (folder / f"{name}.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    print(text)

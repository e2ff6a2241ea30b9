"""Compare the online map, its post refinement and offline 3DGS, and show where the time goes, as the paper's tables.

Offline 3DGS gets as many view renders (forward and backward) as the online run with its first post refinement. Finished
runs are kept in the output folder and reused as long as their settings are the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ending import documented_ending
from experiments import (
    Figures,
    Job,
    command_line,
    execute,
    experiment_parser,
    mapping_seconds,
    markdown_table,
    mean_figures,
    named_scenes,
    quality,
    with_mean,
    write_report,
)

from modp_ti.files.errors import InputError

ONLINE, OFFLINE = "online", "offline 3DGS"
COLUMNS = {
    "PSNR": ("psnr", ".2f"),
    "SSIM": ("ssim", ".3f"),
    "LPIPS": ("lpips", ".3f"),
    "steps": ("steps", ",.0f"),
    "# Gaussians": ("gaussians", ",.0f"),
    "view renders": ("view_renders", ",.0f"),
    "time [s]": ("seconds", ",.0f"),
}
# The paper's columns and their names in metrics.json.
BREAKDOWN = {
    "Optim": "optimise",
    "Cam Select": "select",
    "Depth Est.": "depth",
    "MOHV": "occupancy",
    "Others": "others",
}


@documented_ending()
def main() -> None:
    """Run the missing jobs, then print and write the tables."""
    parser = experiment_parser(__doc__, "scripts/compare desk.yaml -o out/comparison --steps 1000 3000")
    parser.add_argument(
        "--steps", nargs="+", type=int, default=[1000], help="post refinements, a run for each (default 1000)"
    )
    parser.add_argument("--no-offline", action="store_true", help="leave offline 3DGS out")
    arguments = parser.parse_args()
    if min(arguments.steps) < 1:
        parser.error("--steps must be positive: the online map is a row in any case")
    figures: dict[str, dict[str, Figures]] = {}
    breakdown: dict[str, Figures] = {}
    common = command_line(arguments.set)
    refinements = list(dict.fromkeys(arguments.steps))
    scenes = named_scenes(arguments.scenes)
    jobs = {
        scene: [refined_job(scene, file, arguments.output / scene, steps, common) for steps in refinements]
        for scene, file in scenes.items()
    }
    for scene, file in scenes.items():  # reports bad settings before the first run, which may take hours
        offline = [] if arguments.no_offline else [offline_job(scene, file, arguments.output / scene, 1, common)]
        for job in (*jobs[scene], *offline):
            job.check()
    for scene, file in scenes.items():
        runs = execute(jobs[scene], arguments.fresh)
        figures[scene] = online_rows(runs, refinements)
        breakdown[scene] = time_breakdown(runs[0])
        if not arguments.no_offline:
            renders = counts(runs[0], "refined")["view_renders"]
            job = offline_job(scene, file, arguments.output / scene, renders, common)
            figures[scene][OFFLINE] = offline_row(execute([job], arguments.fresh)[0])
    text = report(figures, breakdown)
    write_report(arguments.output, "comparison", text, {"quality": figures, "breakdown_percent": breakdown})


def refined_job(scene: str, file: Path, folder: Path, steps: int, common: Mapping[str, str]) -> Job:
    """Return the job of an online run with post refinement. Its metrics contain both maps."""
    return Job(
        f"{scene}, online + {steps:,} steps", file, folder / f"refined-{steps}", {**common, "refine.steps": str(steps)}
    )


def offline_job(scene: str, file: Path, folder: Path, renders: int, common: Mapping[str, str]) -> Job:
    """Return the job of offline 3DGS, which renders one view per step."""
    overrides = {**common, "mode": "offline", "offline.steps": str(renders)}
    return Job(f"{scene}, {OFFLINE}", file, folder / "offline", overrides)


def counts(metrics: Mapping[str, Any], stage: str) -> Figures:
    """Return the number of Gaussians of a map, and of the views rendered forward and backward to make it."""
    if "view_renders" not in metrics[stage]:
        raise InputError("metrics.json does not count view renders: made by an older version; run again with --fresh")
    return {name: metrics[stage][name] for name in ("gaussians", "view_renders")}


def online_rows(runs: Sequence[Mapping[str, Any]], refinements: Sequence[int]) -> dict[str, Figures]:
    """Return the rows of the online map and of each post refinement.

    Args:
        runs: Metrics of the runs.
        refinements: Refinement steps of each run.
    """
    seconds = mapping_seconds(runs[0], refined=False)
    first = quality(runs[0]["online"]) | counts(runs[0], "online") | {"steps": 0, "seconds": seconds}
    rows: dict[str, Figures] = {ONLINE: first}
    for metrics, steps in zip(runs, refinements, strict=True):
        row = quality(metrics["refined"]) | counts(metrics, "refined")
        rows[f"{ONLINE} + {steps:,} steps"] = row | {"steps": steps, "seconds": mapping_seconds(metrics, refined=True)}
    return rows


def offline_row(metrics: Mapping[str, Any]) -> Figures:
    """Return the row of offline 3DGS, where every step optimises."""
    row = quality(metrics["offline"]) | counts(metrics, "offline")
    return row | {"steps": row["view_renders"], "seconds": mapping_seconds(metrics, refined=True)}


def time_breakdown(metrics: Mapping[str, Any]) -> Figures:
    """Return the online run's time by the paper's columns [%], and its frames per second."""
    percent = metrics["breakdown_percent"]
    return {label: percent[stage] for label, stage in BREAKDOWN.items()} | {"FPS": metrics["frames_per_second"]}


def report(figures: Mapping[str, Mapping[str, Figures]], breakdown: Mapping[str, Figures]) -> str:
    """Return the tables as Markdown, first for the mean over the scenes, then for each scene.

    Args:
        figures: Figures by scene and row.
        breakdown: Time by scene [%].
    """
    times = dict(breakdown)
    if len(figures) > 1:
        times["mean"] = mean_figures(list(breakdown.values()))
    parts = [
        "# Online and offline",
        "Held-out frames; all frames where none is held out. Time without compiling, the tracker's preparation and "
        "evaluation.",
    ]
    for title, rows in with_mean(figures).items():
        parts += [f"## {title}", markdown_table("map", COLUMNS, rows)]
    columns = {label: (label, ".2f") for label in (*BREAKDOWN, "FPS")}
    return "\n\n".join([*parts, "## Time of the online run, percent", markdown_table("scene", columns, times)])


if __name__ == "__main__":
    main()

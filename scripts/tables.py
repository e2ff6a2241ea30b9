"""Run the tables of the paper on your scenes and print them as Markdown: `scripts/ablate`, `scripts/compare`.

Runs are the scenes of a batch (docs/scale.md) below the output folder: those that are finished with the same settings
are not repeated, and the same command runs what is left.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ending import documented_ending

from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.files.terminal import CleanConsole
from modp_ti.many.batch import LOGS, Scene, for_a_task, run_batch
from modp_ti.many.pool import LocalPool
from modp_ti.outputs.formats.run_files import read_scores

# Figures of one table row by name; None if a run does not have the figure.
Figures = Mapping[str, float | None]
# Stages of metrics.json that are not mapping and do not depend on the method.
NOT_MAPPING = ("compile", "track", "evaluate")

# ---- ablations
FULL, OTHER_TRACKER = "full", "other tracker"
# Without global views, the local bank provides as many more views, so that each step keeps the budget of the full
# method.
VARIANTS: dict[str, dict[str, str]] = {
    "w/o EC": {"mapping.densify.error_compensation": "false"},
    "w/o MOHV": {"mapping.voxels.enabled": "false"},
    "w/o EC & MOHV": {"mapping.densify.error_compensation": "false", "mapping.voxels.enabled": "false"},
    "w/o global cams": {"mapping.views.global_views": "0", "mapping.views.local_views": "5"},
    "w/o cam refinement": {"mapping.poses.enabled": "false"},
    FULL: {},
}
QUALITY = {"PSNR": ("psnr", ".2f"), "SSIM": ("ssim", ".3f"), "LPIPS": ("lpips", ".3f")}
GAUSSIANS = {"# Gaussians": ("gaussians", ",.0f")}
FIRST_THIRD = {"held-out PSNR, first third": ("first_third_psnr", ".2f")}
# The paper's tables as (title, columns, rows).
ABLATIONS = (
    ("Gaussian management", QUALITY | GAUSSIANS, ("w/o EC", "w/o MOHV", "w/o EC & MOHV", FULL)),
    ("Global consistent optimisation", QUALITY | FIRST_THIRD, ("w/o global cams", "w/o cam refinement", FULL)),
    ("Tracking", QUALITY | GAUSSIANS, (OTHER_TRACKER, FULL)),
)

# ---- the comparison of the online map, its refinement and offline 3DGS
ONLINE, OFFLINE = "online", "offline 3DGS"
COMPARED = {
    **QUALITY,
    "steps": ("steps", ",.0f"),
    **GAUSSIANS,
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
ABOUT = "Held-out frames; all frames where none is held out."


@documented_ending()
def main() -> None:
    """Run what is missing, then print and write the tables."""
    options = argparse.ArgumentParser(
        prog="scripts",
        description=__doc__,
        epilog="example: scripts/ablate desk.yaml fox.yaml -o out/ablation",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    which = options.add_subparsers(required=True)
    ablation = which.add_parser("ablate", help="the paper's ablations, without post refinement unless --refine sets it")
    ablation.set_defaults(tables=ablate)
    ablation.add_argument(
        "--tracker", nargs="+", default=[], metavar="other.yaml", help="for each scene the same with another tracker"
    )
    ablation.add_argument("--refine", type=int, default=0, metavar="STEPS", help="post refinement of each run")
    ablation.add_argument("--only", nargs="+", choices=list(VARIANTS), help="these variants instead of all")
    comparison = which.add_parser("compare", help="the online map, its post refinement, and offline 3DGS")
    comparison.set_defaults(tables=compare)
    comparison.add_argument(
        "--steps", nargs="+", type=int, default=[1000], help="post refinements, a run for each (default 1000)"
    )
    comparison.add_argument("--no-offline", action="store_true", help="leave offline 3DGS out")
    for parser in (ablation, comparison):
        parser.add_argument("scenes", nargs="+", metavar="scene.yaml", help="scene files, one or several")
        parser.add_argument("-o", "--output", required=True, type=Path, help="folder of the runs and of the tables")
        parser.add_argument("--fresh", action="store_true", help="repeat finished runs")
        parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of every run")
    arguments = options.parse_args()
    arguments.tables(arguments)


def ablate(options: argparse.Namespace) -> None:
    """Print and write the paper's ablations."""
    scenes = named_scenes(options.scenes)
    if options.tracker and len(options.tracker) != len(scenes):
        raise InputError(f"--tracker needs one file for each of the {len(scenes)} scenes, got {len(options.tracker)}")
    common = {"refine.steps": str(options.refine)} | command_line(options.set)
    variants = {name: common | VARIANTS[name] for name in options.only or VARIANTS}
    others = dict(zip(scenes, map(Path, options.tracker), strict=False))
    runs = runs_of(scenes, options.output, variants) | runs_of(others, options.output, {OTHER_TRACKER: common})
    figures: dict[str, dict[str, Figures]] = {scene: {} for scene in scenes}
    for (scene, variant), metrics in execute(runs, options.output, options.fresh).items():
        stage = "refined" if metrics.get("refined") else "online"
        figures[scene][variant] = quality(metrics[stage]) | {
            "gaussians": metrics["gaussians"],
            "first_third_psnr": first_third_psnr(runs[scene, variant].output / "scores.csv", stage),
        }
    write_report(options.output, "ablation", ablation_report(figures), figures)


def ablation_report(figures: Mapping[str, Mapping[str, Figures]]) -> str:
    """Return the paper's ablations as Markdown, given the figures by scene and variant."""
    parts = ["# Ablations", ABOUT]
    for title, rows in with_mean(figures).items():
        parts.append(f"## {title}")
        for name, columns, variants in ABLATIONS:
            shown = {variant: rows[variant] for variant in variants if variant in rows}
            if len(shown) > 1:
                parts.append(markdown_table(name, columns, shown))
    return "\n\n".join(parts)


def compare(options: argparse.Namespace) -> None:
    """Print and write the comparison. Offline 3DGS gets as many view renders as the run with the first refinement."""
    scenes, common, output = named_scenes(options.scenes), command_line(options.set), options.output
    if min(options.steps) < 1:
        raise InputError("--steps must be positive: the online map is a row in any case")
    refined = {f"refined-{steps}": steps for steps in options.steps}
    online = runs_of(scenes, output, {name: common | {"refine.steps": steps} for name, steps in refined.items()})
    offline = common | {"mode": "offline"}
    runs_of(
        {} if options.no_offline else scenes, output, {OFFLINE: offline}
    )  # reports bad settings before hours of runs
    done = execute(online, output, options.fresh)
    figures: dict[str, dict[str, Figures]] = {}
    breakdown: dict[str, Figures] = {}
    for scene, file in scenes.items():
        of_scene = {steps: done[scene, name] for name, steps in refined.items()}
        first = next(iter(of_scene.values()))
        figures[scene] = {ONLINE: _row(first, "online", 0)}
        figures[scene] |= {f"{ONLINE} + {steps:,} steps": _row(of, "refined", steps) for steps, of in of_scene.items()}
        breakdown[scene] = {label: first["breakdown_percent"][stage] for label, stage in BREAKDOWN.items()}
        breakdown[scene] |= {"FPS": first["frames_per_second"]}
        if not options.no_offline:
            renders = first["refined"]["view_renders"]
            run = runs_of({scene: file}, output, {OFFLINE: offline | {"offline.steps": renders}})
            (metrics,) = execute(run, output, options.fresh).values()
            figures[scene][OFFLINE] = _row(metrics, "offline", renders)
    text = comparison_report(figures, breakdown)
    write_report(output, "comparison", text, {"quality": figures, "breakdown_percent": breakdown})


def _row(metrics: Mapping[str, Any], stage: str, steps: int) -> Figures:
    counts = {name: metrics[stage][name] for name in ("gaussians", "view_renders")}
    seconds = mapping_seconds(metrics, refined=stage != "online")
    return quality(metrics[stage]) | counts | {"steps": steps, "seconds": seconds}


def comparison_report(figures: Mapping[str, Mapping[str, Figures]], breakdown: Mapping[str, Figures]) -> str:
    """Return the comparison as Markdown, given the figures by scene and row and the time by scene [%]."""
    times = dict(breakdown)
    if len(figures) > 1:
        times["mean"] = mean_figures(list(breakdown.values()))
    parts = [
        "# Online and offline",
        f"{ABOUT} Time without compiling, the tracker's preparation and evaluation.",
    ]
    for title, rows in with_mean(figures).items():
        parts += [f"## {title}", markdown_table("map", COMPARED, rows)]
    columns = {label: (label, ".2f") for label in (*BREAKDOWN, "FPS")}
    return "\n\n".join([*parts, "## Time of the online run, percent", markdown_table("scene", columns, times)])


# ---- runs ------------------------------------------------------------------------------------------------------------


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


def command_line(settings: Iterable[str]) -> dict[str, Any]:
    """Parse `key=value` texts of `--set` into overrides. Later ones win."""
    overrides = {}
    for text in settings:
        key, equals, value = text.partition("=")
        if not equals:
            raise InputError(f"--set {text}: write it as section.key=value, for example source.scale=0.5")
        overrides[key.strip()] = value
    return overrides


def _folder(variant: str) -> str:
    return variant.replace("w/o", "without").replace("& ", "").replace(" ", "-").lower()


def settings_of(scene: Path, folder: Path, overrides: Mapping[str, Any]) -> SceneConfig:
    """Return the settings of a run. Raises InputError if they are not valid."""
    # JSON is valid YAML, whatever characters the path contains.
    overrides = {**overrides, "output": json.dumps(str(folder.resolve()))}
    return load_scene(scene, [f"{key}={value}" for key, value in overrides.items()])


def runs_of(
    scenes: Mapping[str, Path], output: Path, variants: Mapping[str, Mapping[str, Any]]
) -> dict[tuple[str, str], SceneConfig]:
    """Return the settings of the runs of each scene with each variant's overrides, by the names of both."""
    return {
        (scene, name): settings_of(file, output / scene / _folder(name), overrides)
        for scene, file in scenes.items()
        for name, overrides in variants.items()
    }


def execute(
    runs: Mapping[tuple[str, str], SceneConfig], output: Path, fresh: bool = False
) -> dict[tuple[str, str], dict[str, Any]]:
    """Carry out the runs that are not finished, one after the other, and return the metrics of all.

    Args:
        runs: Settings by scene and name.
        output: Folder of the batch that they are.
        fresh: Repeat those that are finished.

    Raises:
        InputError: If a run fails.
    """
    scenes = []
    for (scene, name), config in runs.items():
        if fresh:
            (config.output / "metrics.json").unlink(missing_ok=True)
        scenes.append(Scene(f"{scene}-{_folder(name)}", config.output, for_a_task(config)))
    with LocalPool(output / LOGS, jobs=1) as pool:
        results = run_batch(scenes, pool, output, console=CleanConsole(stderr=True))
    for result in results:
        if not result.state.is_done:
            raise InputError(f"{result.name}: {result.error}; the same command runs what is left")
    return {key: json.loads((config.output / "metrics.json").read_text("utf-8")) for key, config in runs.items()}


# ---- figures ---------------------------------------------------------------------------------------------------------


def quality(section: Mapping[str, Any]) -> dict[str, float | None]:
    """Return psnr, ssim and lpips of a section of metrics.json: of the held-out frames, or of all if there are none."""
    scores = section["held_out"] if section["held_out"]["count"] else section["all"]
    return {name: scores[name] for name in ("psnr", "ssim", "lpips")}


def mapping_seconds(metrics: Mapping[str, Any], refined: bool, left_out: Iterable[str] = NOT_MAPPING) -> float:
    """Return a run's time [s] without the stages that are left out, and without the refinement unless `refined`."""
    seconds = metrics["seconds"]
    others = sum(seconds.get(stage, 0.0) for stage in left_out)
    return seconds["total"] - others - (0.0 if refined else seconds.get("refine", 0.0))


def first_third_psnr(file: Path, stage: str) -> float | None:
    """Return the mean PSNR over the first third of the frames of scores.csv, None without it.

    It covers the held-out frames, or all if there are none.
    """
    if not file.is_file():
        return None
    scores = sorted((score for score in read_scores(file) if score.stage == stage), key=lambda score: score.index)
    some_held_out = any(score.held_out for score in scores)
    early = scores[: -(-len(scores) // 3)]
    counted = [score.psnr for score in early if score.held_out or not some_held_out]
    return statistics.fmean(counted) if counted else None


def mean_figures(scenes: Sequence[Figures]) -> Figures:
    """Return the mean of every figure over the scenes, None if a scene lacks it."""
    known = {name: [value for of in scenes if (value := of[name]) is not None] for name in scenes[0]}
    return {name: statistics.fmean(of) if len(of) == len(scenes) else None for name, of in known.items()}


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
        values = [(figures.get(name), form) for name, form in columns.values()]
        cells = ["–" if value is None else format(value, form) for value, form in values]
        lines.append("| " + " | ".join([label, *cells]) + " |")
    return "\n".join(lines)


def write_report(folder: Path, name: str, text: str, figures: Any) -> None:
    """Print the Markdown text, and write NAME.md and NAME.json to the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.md").write_text(text + "\n", encoding="utf-8")
    (folder / f"{name}.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()

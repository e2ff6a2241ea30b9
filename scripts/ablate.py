"""Run the paper's ablations on your scenes and print them as Markdown tables.

Every variant is a separate run, without post refinement unless --refine sets it. Finished runs are kept in the output
folder and reused as long as their settings are the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from ending import documented_ending
from experiments import (
    Figures,
    Job,
    command_line,
    execute,
    experiment_parser,
    first_third_psnr,
    markdown_table,
    named_scenes,
    quality,
    with_mean,
    write_report,
)

from modp_ti.files.errors import InputError

FULL = "full"
OTHER_TRACKER = "other tracker"
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
TABLES = (
    ("Gaussian management", QUALITY | GAUSSIANS, ("w/o EC", "w/o MOHV", "w/o EC & MOHV", FULL)),
    ("Global consistent optimisation", QUALITY | FIRST_THIRD, ("w/o global cams", "w/o cam refinement", FULL)),
    ("Tracking", QUALITY | GAUSSIANS, (OTHER_TRACKER, FULL)),
)


@documented_ending()
def main() -> None:
    """Run the missing variants, then print and write the tables."""
    parser = experiment_parser(__doc__, "scripts/ablate desk.yaml fox.yaml -o out/ablation")
    parser.add_argument(
        "--tracker", nargs="+", default=[], metavar="other.yaml", help="for each scene the same with another tracker"
    )
    parser.add_argument(
        "--refine", type=int, default=0, metavar="STEPS", help="post refinement of each run (default 0)"
    )
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), help="these variants instead of all")
    arguments = parser.parse_args()
    scenes = named_scenes(arguments.scenes)
    common = {"refine.steps": str(arguments.refine)} | command_line(arguments.set)
    jobs = plan(scenes, arguments.output, common, arguments.tracker, arguments.only or VARIANTS)
    rest = iter(execute([job for of_scene in jobs.values() for job in of_scene.values()], arguments.fresh))
    figures = {
        scene: {variant: summary(next(rest), job.folder) for variant, job in of_scene.items()}
        for scene, of_scene in jobs.items()
    }
    write_report(arguments.output, "ablation", report(figures), figures)


def plan(
    scenes: Mapping[str, Path],
    output: Path,
    common: Mapping[str, str],
    trackers: Sequence[str] = (),
    variants: Iterable[str] = VARIANTS,
) -> dict[str, dict[str, Job]]:
    """Return the jobs by scene and variant.

    Args:
        scenes: Scene files by name.
        output: Folder of the runs.
        common: Overrides for every run.
        trackers: For each scene, a scene file with another tracker; or empty.
        variants: Names of the variants.

    Raises:
        InputError: If the number of `trackers` does not match.
    """
    if trackers and len(trackers) != len(scenes):
        raise InputError(f"--tracker needs one file for each of the {len(scenes)} scenes, got {len(trackers)}")

    def job(scene: str, file: Path, variant: str) -> Job:
        folder = variant.replace("w/o", "without").replace("& ", "").replace(" ", "-").lower()
        return Job(f"{scene}, {variant}", file, output / scene / folder, {**common, **VARIANTS.get(variant, {})})

    jobs = {scene: {name: job(scene, file, name) for name in variants} for scene, file in scenes.items()}
    for scene, other in zip(scenes, trackers, strict=False):
        jobs[scene][OTHER_TRACKER] = job(scene, Path(other).resolve(), OTHER_TRACKER)
    return jobs


def summary(metrics: Mapping, folder: Path) -> Figures:
    """Return the figures of a run for the tables, from the refined map if there is one."""
    stage = "refined" if metrics.get("refined") else "online"
    return quality(metrics[stage]) | {
        "gaussians": metrics["gaussians"],
        "first_third_psnr": first_third_psnr(folder, stage),
    }


def report(figures: Mapping[str, Mapping[str, Figures]]) -> str:
    """Return the paper's tables as Markdown, first for the mean over the scenes, then for each scene.

    Args:
        figures: Figures by scene and variant.
    """
    parts = ["# Ablations", "Held-out frames; all frames where none is held out."]
    for title, rows in with_mean(figures).items():
        parts.append(f"## {title}")
        for name, columns, variants in TABLES:
            shown = {v: rows[v] for v in variants if v in rows}
            if len(shown) > 1:
                parts.append(markdown_table(name, columns, shown))
    return "\n\n".join(parts)


if __name__ == "__main__":
    main()

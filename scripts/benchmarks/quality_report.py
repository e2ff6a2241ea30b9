"""Formats quality against processor time as Markdown and as a plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from experiments import Figures, markdown_table

from benchmarks.quality import Point, psnr_at, seconds_to

__all__ = ["plot", "report"]

MINUTES = (0.5, 1, 2, 4, 8, 16)
POINTS = {
    "PSNR": ("psnr", ".2f"),
    "SSIM": ("ssim", ".3f"),
    "Gaussians": ("gaussians", ",.0f"),
    "view renders": ("view_renders", ",.0f"),
    "processor [s]": ("seconds", ",.1f"),
}
Curves = Mapping[str, Mapping[str, Sequence[Point]]]


def report(curves: Curves) -> str:
    """Return the tables: quality per minute, time for equal quality with two programs, and all points.

    Args:
        curves: Points by scene and program.
    """
    parts = [
        "# Quality per minute",
        "Held-out PSNR [dB] after so many minutes of processor time on one thread, from the first frame on, without "
        "compilation and scoring: the best of the online and the refined maps of all budgets, interpolated.",
    ]
    columns = {f"{minutes:g} min": (f"{minutes:g}", ".2f") for minutes in MINUTES}
    rows: dict[str, Figures] = {}
    for scene, of in curves.items():
        for program, points in of.items():
            rows[f"{scene}, {program}"] = {f"{minutes:g}": psnr_at(points, 60 * minutes) for minutes in MINUTES}
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
        for stage in ("online", "refined"):
            comparable = [point for point in new if point.stage == stage]
            for point in (point for point in old if point.stage == stage):
                seconds = seconds_to(comparable, point.psnr) if comparable else None
                rows[f"{scene}, {stage}, {point.steps} steps"] = {
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
    """Write a PNG with PSNR over processor time, a panel for each scene.

    Args:
        curves: Points by scene and program.
        file: The picture.
    """
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

"""The content of the report's tables: changed settings, the machine and its libraries, and the run's figures."""

from __future__ import annotations

import math
import os
import platform
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from fields.runtime.engine import engine
from fields.runtime.process import available_cores
from modp_ti.config.keys import as_yaml, documented_values
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import without_secrets
from modp_ti.outputs.progress import duration
from modp_ti.version import __version__

PACKAGES = {"PyTorch": "torch", "NumPy": "numpy", "OpenCV": "opencv-python-headless"}
STAGES = {
    "compile": "compiling kernels",
    "read": "waiting for frames to be read",
    "track": "preparing the tracker",
    "select": "choosing keyframes and views",
    "depth": "estimating depth",
    "occupancy": "adding Gaussians where voxels are free",
    "optimise": "optimising the map",
    "refine": "post refinement",
    "evaluate": "evaluating the saved map",
    "other": "the rest",
}
# What a good figure is, by the name of its metric.
GOOD_FIGURES = {
    "psnr": "PSNR: 25 dB is fair, 30 dB good, 35 dB and more hard to tell from the frame.",
    "ssim": "SSIM: 0.85 is fair, 0.9 good, 0.95 and more very good; 1 is the frame itself.",
    "lpips": "LPIPS: less is better; 0.3 is fair, 0.2 good, 0.1 and less very good; 0 is the frame itself.",
    "detail": "Detail: the share of the finest detail that the map shows; 0.5 is sharp, 0 is a blurred frame.",
    "ate_rmse": "Trajectory error: root mean square distance of the cameras from the ground truth after the best turn, "
    "shift and scale; 1 % of the size of the path is good. With the map's own scale, it includes the error of the "
    "scale, which a single camera cannot measure.",
}
# An absolute path, or one in the home folder.
PATH = re.compile(r"""(?<![\w.:~/\\-])(~|/[^\s/"':,;()]+|[A-Za-z]:)(?:[/\\]+[^\s/\\"':,;()]+)+""")
OTHERS = {
    "frames_per_second": ("frames per second while mapping", ".2f", ""),
    "peak_memory_mb": ("most memory held", ",.0f", " MB"),
    "ate_rmse_tracked": ("trajectory error of the tracker [units of the ground truth]", ".4g", ""),
    "ate_rmse": ("trajectory error after mapping [units of the ground truth]", ".4g", ""),
    "ate_rmse_rigid": ("trajectory error after mapping, with the map's own scale [same units]", ".4g", ""),
    "reprojection_error_tracked": ("tracked points from their pixels, tracker's poses", ".3f", " px"),
    "reprojection_error": ("tracked points from their pixels, poses after mapping", ".3f", " px"),
    "reprojection_error_anew_tracked": ("points triangulated again, from their pixels, tracker's poses", ".3f", " px"),
    "reprojection_error_anew": ("points triangulated again, from their pixels, poses after mapping", ".3f", " px"),
}


def changed_settings(config: SceneConfig) -> list[tuple[str, str, str | None]]:
    """Return the settings that differ from their defaults, in the order of the settings reference.

    Returns:
        Dotted key, value as YAML text and default as YAML text of each setting. The default is None if there is none.
    """
    texts = [(entry, "" if value is None else as_yaml(value)) for entry, value in documented_values(config)]
    return [(entry.key, text, entry.default) for entry, text in texts if text != entry.default]


def machine(device: str) -> dict[str, str]:
    """Return versions and hardware by label.

    Args:
        device: Description of the backend that the run used.
    """
    packages = [str(engine())]
    for name, package in PACKAGES.items():
        with suppress(PackageNotFoundError):  # installed by another distribution package
            packages.append(f"{name} {version(package)}")
    cores, text = available_cores(), ""
    with suppress(OSError):
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    found = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    processor = found[1].strip() if found else platform.processor() or platform.machine()
    return {
        "MODP-Ti": __version__,
        "backend": device,
        "processor": f"{processor}, {cores} core{'s' if cores > 1 else ''}",
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "libraries": ", ".join(packages),
    }


def shareable(text: str, *folders: Path) -> str:
    """Remove from text what a page must not give away, since pages are shared.

    URLs are without user, password and query. Paths in one of the folders become relative to it; of other absolute
    paths, the last name is left.
    """
    text = without_secrets(text)
    for folder in sorted({*folders} - {Path(folder.anchor) for folder in folders}, key=lambda f: -len(str(f))):
        text = re.sub(rf"(?<![\w./-]){re.escape(str(folder))}[/\\]+", "", text)
    home = os.path.expanduser("~")
    if len(Path(home).parts) > 1:
        text = re.sub(rf"(?<![\w./-]){re.escape(home)}(?!\w)", "~", text)
    # A name that no folder at the root has is no path but, for example, a topic of a bag.
    return PATH.sub(lambda m: re.split(r"[/\\]", m[0])[-1] if m[1] == "~" or Path(m[1]).exists() else m[0], text)


def scene_folders(config: SceneConfig) -> list[Path]:
    """Return the folders that paths of a page are relative to: those of the recording and of the output."""
    return [path.parent for path in (config.source.path, config.output) if path is not None]


def last_stage(metrics: Mapping[str, Any]) -> str:
    """Return the name of the run's final map version: "refined", "online" or "offline"."""
    return next(stage for stage in ("refined", "online", "offline") if metrics[stage] is not None)


def headline(metrics: Mapping[str, Any]) -> dict[str, str]:
    """Return the main figures by label."""
    scores = metrics[last_stage(metrics)]
    of, means = ("held-out", scores["held_out"]) if scores["held_out"]["count"] else ("all frames", scores["all"])
    figures = {f"PSNR, {of}": f"{shown(means['psnr'], '.2f')} dB"}
    if (fitted := scores.get("fitted", {}).get("psnr")) is not None:
        figures["PSNR, fitted"] = f"{shown(fitted, '.2f')} dB"
    figures[f"SSIM, {of}"] = shown(means["ssim"], ".3f")
    if means["lpips"] is not None:
        figures[f"LPIPS, {of}"] = shown(means["lpips"], ".3f")
    counts = {"Gaussians": "gaussians", "frames": "frames", "keyframes": "keyframes"}
    figures |= {label: f"{metrics[name]:,}" for label, name in counts.items()}
    return figures | {"time": duration(metrics["seconds"]["total"])}


def side_by_side(metrics: Mapping[str, Any]) -> dict[str, str]:
    """Return what the table of scores compares: headings by key in metrics.json. Older runs have no fitted frames."""
    names = {"held_out": "held-out frames", "fitted": "fitted frames", "all": "all frames"}
    scores = metrics[last_stage(metrics)]
    shown = [name for name in names if scores.get(name, {"count": 0})["count"]]
    return {name: names[name] for name in shown[:2]}


def other_figures(metrics: Mapping[str, Any]) -> dict[str, str]:
    """Return the figures of metrics.json that have no table of their own by label, as far as the run has them."""
    figures = {
        label: shown(metrics[name], form) + unit
        for name, (label, form, unit) in OTHERS.items()
        if metrics.get(name) is not None
    }
    corrections = metrics.get("corrections") or {"received": 0}
    if corrections["received"]:
        moved = f"{corrections['received']}, of which {corrections['moved']} moved the map"
        figures["corrections from the tracker"] = moved
    if live := metrics.get("live"):
        lag = live["lag_seconds"]
        figures |= {
            "lag behind the camera": f"{lag['median']:.2f} s, 95 %: {lag['p95']:.2f} s, most: {lag['max']:.2f} s",
            "frames": f"{live['arrived']:,} arrived, {live['tracked']:,} tracked, {live['thinned']:,} left out evenly, "
            f"{live['lost']:,} lost",
            "keyframes without work": f"{live['keyframes_skipped']:,} skipped, {live['keyframes_merged']:,} merged",
            "steps a keyframe": f"{live['steps_per_keyframe']:.1f}, and {live['further_steps']:,} between frames",
        }
    kept = (metrics.get("retention") or {}).get(last_stage(metrics))
    if kept is not None:
        text = f"{kept['mean']:+.2f} dB in the mean, {kept['worst']:+.2f} dB in the worst 20 in a row"
        figures["keyframes at the end, against just mapped"] = text
    return figures


def stages(metrics: Mapping[str, Any]) -> list[tuple[str, str, float, float]]:
    """Return name, description, time [s] and share of the total time [%] of each stage that took some."""
    seconds = metrics["seconds"]
    share = 100.0 / max(seconds["total"], 1e-9)
    taken = [(name, meaning, seconds[name]) for name, meaning in STAGES.items() if seconds[name] > 0]
    return [(*stage, share * stage[2]) for stage in taken]


def shown(value: float | None, form: str) -> str:
    """Format a figure; a dash if it is None or not finite."""
    return "–" if value is None or not math.isfinite(value) else format(value, form)


def good_figures(metrics: Mapping[str, Any]) -> list[str]:
    """Return what good figures are, one line for each kind of figure that the run has."""
    known = {**metrics, **metrics[last_stage(metrics)]["all"]}
    return [text for name, text in GOOD_FIGURES.items() if known.get(name) is not None]


def remarks(metrics: Mapping[str, Any], notes: Iterable[str]) -> list[str]:
    """Return the run's notes, with a warning if no frame was held out."""
    said = list(notes)
    if not metrics[last_stage(metrics)]["held_out"]["count"]:
        said.append("no frame was held out: the scores are of frames that the map was made of, and flatter it")
    return said

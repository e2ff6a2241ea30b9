"""The content of the report's tables: changed settings, the machine and its libraries, and the run's figures."""

from __future__ import annotations

import math
import os
import platform
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from modp_ti.config.keys import as_yaml, documented_values
from modp_ti.config.settings import SceneConfig
from modp_ti.version import __version__

__all__ = [
    "Change",
    "Figure",
    "Stage",
    "changed_settings",
    "headline",
    "last_stage",
    "machine",
    "other_figures",
    "remarks",
    "shown",
    "stages",
    "without_credentials",
]

PACKAGES = {"Taichi": "taichi", "PyTorch": "torch", "NumPy": "numpy", "OpenCV": "opencv-python-headless"}
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
OTHERS = {
    "frames_per_second": ("frames per second while mapping", ".2f", ""),
    "peak_memory_mb": ("most memory held", ",.0f", " MB"),
    "ate_rmse_tracked": ("trajectory error of the tracker [units of the ground truth]", ".4g", ""),
    "ate_rmse": ("trajectory error after mapping", ".4g", ""),
    "ate_rmse_rigid": ("trajectory error after mapping, aligned without scale", ".4g", ""),
    "reprojection_error_tracked": ("tracked points from their pixels, tracker's poses", ".3f", " px"),
    "reprojection_error": ("tracked points from their pixels, poses after mapping", ".3f", " px"),
    "reprojection_error_anew_tracked": ("points placed anew from their pixels, tracker's poses", ".3f", " px"),
    "reprojection_error_anew": ("points placed anew from their pixels, poses after mapping", ".3f", " px"),
}


@dataclass(frozen=True)
class Change:
    """A setting that differs from its default.

    Attributes:
        key: Dotted key.
        value: Value as YAML text.
        default: Default as YAML text, None if there is no default.
    """

    key: str
    value: str
    default: str | None


@dataclass(frozen=True)
class Figure:
    """A formatted number and its label."""

    label: str
    value: str


@dataclass(frozen=True)
class Stage:
    """Time of a stage of the run.

    Attributes:
        name: Key in metrics.json.
        meaning: Description for readers.
        seconds: Time [s].
        share: Share of the total time [%].
    """

    name: str
    meaning: str
    seconds: float
    share: float


def without_credentials(text: str) -> str:
    """Remove user names and passwords from URLs in the text, since reports are shared."""
    return re.sub(r"(?<=://)[^/@\s\"']+@", "", text)


def changed_settings(config: SceneConfig) -> list[Change]:
    """Return the settings that differ from their defaults, in the order of the settings reference."""
    changes = []
    for entry, value in documented_values(config):
        text = "" if value is None else as_yaml(value)
        if text != entry.default:
            changes.append(Change(entry.key, without_credentials(text), entry.default))
    return changes


def machine(device: str) -> list[Figure]:
    """Return versions and hardware.

    Args:
        device: Description of the backend that the run used.
    """
    packages = []
    for name, package in PACKAGES.items():
        try:
            packages.append(f"{name} {version(package)}")
        except PackageNotFoundError:  # installed by another distribution package
            continue
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return [
        Figure("MODP-Ti", __version__),
        Figure("backend", device),
        Figure("processor", f"{_processor()}, {cores} core{'s' if cores > 1 else ''}"),
        Figure("system", f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"),
        Figure("libraries", ", ".join(packages)),
    ]


def _processor() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    found = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return found[1].strip() if found else platform.processor() or platform.machine()


def last_stage(metrics: Mapping[str, Any]) -> str:
    """Return the name of the run's final map version: "refined", "online" or "offline"."""
    return next(stage for stage in ("refined", "online", "offline") if metrics[stage] is not None)


def headline(metrics: Mapping[str, Any]) -> list[Figure]:
    """Return the main figures."""
    scores = metrics[last_stage(metrics)]
    which = "held_out" if scores["held_out"]["count"] else "all"
    of = "held-out" if which == "held_out" else "all frames"
    figures = [Figure(f"PSNR, {of}", f"{shown(scores[which]['psnr'], '.2f')} dB")]
    figures.append(Figure(f"SSIM, {of}", shown(scores[which]["ssim"], ".3f")))
    if scores[which]["lpips"] is not None:
        figures.append(Figure(f"LPIPS, {of}", shown(scores[which]["lpips"], ".3f")))
    return [
        *figures,
        Figure("Gaussians", f"{metrics['gaussians']:,}"),
        Figure("frames", f"{metrics['frames']:,}"),
        Figure("keyframes", f"{metrics['keyframes']:,}"),
        Figure("time", duration(metrics["seconds"]["total"])),
    ]


def other_figures(metrics: Mapping[str, Any]) -> list[Figure]:
    """Return the figures of metrics.json that have no table of their own, as far as the run has them."""
    figures = [
        Figure(label, shown(metrics[name], form) + unit)
        for name, (label, form, unit) in OTHERS.items()
        if metrics.get(name) is not None
    ]
    corrections = metrics.get("corrections") or {"received": 0}
    if corrections["received"]:
        text = f"{corrections['received']}, of which {corrections['moved']} moved the map"
        figures.append(Figure("corrections from the tracker", text))
    kept = (metrics.get("retention") or {}).get(last_stage(metrics))
    if kept is not None:
        text = f"{kept['mean']:+.2f} dB in the mean, {kept['worst']:+.2f} dB in the worst 20 in a row"
        figures.append(Figure("keyframes at the end, against just mapped", text))
    return figures


def stages(metrics: Mapping[str, Any]) -> list[Stage]:
    """Return the time of each stage, without stages that took none."""
    seconds = metrics["seconds"]
    total = max(seconds["total"], 1e-9)
    return [
        Stage(name, meaning, seconds[name], 100.0 * seconds[name] / total)
        for name, meaning in STAGES.items()
        if seconds[name] > 0
    ]


def shown(value: float | None, form: str) -> str:
    """Format a figure; a dash if it is None or not finite."""
    return "–" if value is None or not math.isfinite(value) else format(value, form)


def duration(seconds: float) -> str:
    """Format a duration for reading, such as "12 min"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def remarks(metrics: Mapping[str, Any], notes: Iterable[str]) -> list[str]:
    """Return the run's notes, with a warning if no frame was held out."""
    said = [without_credentials(note) for note in notes]
    scores = metrics[last_stage(metrics)]
    if not scores["held_out"]["count"]:
        said.append("no frame was held out: the scores are of frames that the map was made of, and flatter it")
    return said

"""What the tables of a report say: settings that were changed, the machine and its programs, and the run's figures."""

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

from modp_ti import __version__
from modp_ti.config.keys import as_yaml, documented_values
from modp_ti.config.settings import SceneConfig

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
    """A setting that is not its default, both as YAML text; default: None for one that has none."""

    key: str
    value: str
    default: str | None


@dataclass(frozen=True)
class Figure:
    """A number with what it is of."""

    label: str
    value: str


@dataclass(frozen=True)
class Stage:
    """Seconds that a stage took. share: of the whole, in percent."""

    name: str
    meaning: str
    seconds: float
    share: float


def without_credentials(text: str) -> str:
    """The text without user names and passwords in the addresses of streams: reports are passed on."""
    return re.sub(r"(?<=://)[^/@\s\"']+@", "", text)


def changed_settings(config: SceneConfig) -> list[Change]:
    """Settings that are not their defaults, in the order of the reference."""
    changes = []
    for entry, value in documented_values(config):
        text = "" if value is None else as_yaml(value)
        if text != entry.default:
            changes.append(Change(entry.key, without_credentials(text), entry.default))
    return changes


def machine(device: str) -> list[Figure]:
    """Programs and hardware. device: what the run says of the backend that it took."""
    packages = []
    for name, package in PACKAGES.items():
        try:
            packages.append(f"{name} {version(package)}")
        except PackageNotFoundError:  # brought by another distribution
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
    """The version of the map that the run left: "refined", "online" or "offline"."""
    return next(stage for stage in ("refined", "online", "offline") if metrics[stage] is not None)


def headline(metrics: Mapping[str, Any]) -> list[Figure]:
    """The figures that one looks for first."""
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
    """Figures of metrics.json that have no table of their own, those that the run has."""
    figures = [
        Figure(label, shown(metrics[name], form) + unit)
        for name, (label, form, unit) in OTHERS.items()
        if metrics.get(name) is not None
    ]
    corrections = metrics.get("corrections") or {"received": 0}
    if corrections["received"]:
        text = f"{corrections['received']}, of which {corrections['moved']} moved the map"
        figures.append(Figure("corrections from the tracker", text))
    return figures


def stages(metrics: Mapping[str, Any]) -> list[Stage]:
    """Where the time went, without stages that took none."""
    seconds = metrics["seconds"]
    total = max(seconds["total"], 1e-9)
    return [
        Stage(name, meaning, seconds[name], 100.0 * seconds[name] / total)
        for name, meaning in STAGES.items()
        if seconds[name] > 0
    ]


def shown(value: float | None, form: str) -> str:
    """A figure, or a dash where there is none."""
    return "–" if value is None or not math.isfinite(value) else format(value, form)


def duration(seconds: float) -> str:
    """Seconds as a person says them."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def remarks(metrics: Mapping[str, Any], notes: Iterable[str]) -> list[str]:
    """What the run said on its way, and what a reader of its figures should know."""
    said = [without_credentials(note) for note in notes]
    scores = metrics[last_stage(metrics)]
    if not scores["held_out"]["count"]:
        said.append("no frame was held out: the scores are of frames that the map was made of, and flatter it")
    return said

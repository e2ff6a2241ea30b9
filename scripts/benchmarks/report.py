"""Formats the figures of a benchmark as Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from experiments import Figures, markdown_table

from benchmarks.scene import Size
from benchmarks.step import ADAM_BYTES, BACKWARD_FLOPS, FORWARD_FLOPS, LOSS_FLOPS, STAGES

__all__ = ["report", "world_report"]

VOXELS = {
    "query": ("query", ".1f"),
    "update": ("update", ".1f"),
    "admit: both at once": ("admit", ".1f"),
    "MB": ("megabytes", ".0f"),
}
RUNS = {
    "frames": ("frames", ",.0f"),
    "keyframes": ("keyframes", ",.0f"),
    "Gaussians": ("gaussians", ",.0f"),
    "frames per second": ("frames_per_second", ".2f"),
    "compiling [s]": ("compile", ".1f"),
    "waiting for frames [s]": ("read", ".2f"),
    "peak memory [MB]": ("peak_memory_mb", ".0f"),
    "PSNR": ("psnr", ".2f"),
}


def report(figures: Mapping[str, Any]) -> str:
    """Return the tables of all figures (see `collect` in benchmark.py)."""
    columns = {"GFLOP/s": ("gflops", ".0f"), "GB/s": ("gigabytes_per_second", ".1f")}
    parts = [
        f"# Benchmark: {figures['device']}, {figures['cores']} cores",
        "Float32 on this machine: PyTorch's product of 2048 x 2048 matrices, and a = b + s c beyond the caches.",
        markdown_table("machine", columns, {_threads(n): of for n, of in figures["machine"].items()}),
    ]
    for row in figures["steps"]:
        parts += _step(Size(*row["size"]), row["threads"], figures["machine"])
    if "growth" in figures:
        parts += _whole(figures)
    return "\n\n".join(parts)


def world_report(figures: Mapping[str, Any]) -> str:
    """Return the table of a map of copies (see `measure_world`)."""
    columns = {
        "time a frame [s]": ("seconds_per_frame", ".3f"),
        "Gaussians": ("gaussians", ",.0f"),
        "in memory": ("resident", ",.0f"),
        "blocks on disk": ("blocks_on_disk", ",.0f"),
        "memory [MB]": ("resident_mb", ",.0f"),
        "PSNR at the end": ("psnr", ".2f"),
    }
    rows = {str(number): row for number, row in enumerate(figures["copies"], 1)}
    return "\n\n".join(
        [
            f"# {len(rows)} copies side by side, {figures['frames']:,} frames",
            markdown_table("copy", columns, rows),
            f"{figures['gaussians']:,} Gaussians; the last passes took {figures['finishing_seconds']:.0f} s of the "
            f"processor; peak memory {figures['peak_memory_mb']:,.0f} MB.",
        ]
    )


def _step(size: Size, runs: Mapping[str, Mapping], machine: Mapping[str, Mapping]) -> list[str]:
    """Return the paragraphs about a step at one size, given its figures and the machine's by number of threads."""
    first, last = next(iter(runs.values())), runs[max(runs, key=int)]
    visited, whole = first["pairs visited"], first["pairs of whole tiles"]
    at_work = ", ".join(f"{of['cores_had']:.2f} with {_threads(n)}" for n, of in runs.items())
    about = (
        f"{visited / 1e6:.2f} million pixel-Gaussian pairs visited, {whole / 1e6:.2f} million over whole tiles; "
        f"{first['visible']:,.0f} Gaussians visible; peak memory of the process {last['peak_memory_mb']:.0f} MB. "
        f"Cores at work in a step: {at_work}; far fewer than threads where others use the machine."
    )
    pairs: dict[str, Figures] = {}
    for n, of in runs.items():
        for name, stage, twin in (
            ("forward", "compositing", "twin"),
            ("backward", "compositing backward", "twin backward"),
        ):
            pairs[f"{name}, {_threads(n)}"] = {
                "visited": 1e6 * of[stage] / visited,
                "whole": 1e6 * of[stage] / whole,
                "twin": of[twin] / of[stage] if twin in of else None,
            }
    of_pairs = {
        "ns per pair visited": ("visited", ".2f"),
        "ns per pair of whole tiles": ("whole", ".2f"),
        "times faster than the plain twin": ("twin", ".1f"),
    }
    of_stages = {f"{_threads(n)} [ms]": (n, ".2f") for n in runs}
    if len(runs) > 1:
        of_stages["speed-up"] = ("speed-up", ".2f")
    stages = {
        "**whole step**" if name == "step" else name: {n: of[name] for n, of in runs.items()}
        | {"speed-up": first[name] / last[name]}
        for name in (*STAGES, "step")
    }
    tables = markdown_table("compositing", of_pairs, pairs), markdown_table("stage", of_stages, stages)
    return [f"## {size}", about, *tables, *_shares(size, runs, machine)]


def _shares(size: Size, runs: Mapping[str, Mapping], machine: Mapping[str, Mapping]) -> list[str]:
    """Return the table of what the stages of a step use of the machine, and what it counts."""
    shares: dict[str, Figures] = {}
    for n, of in runs.items():
        work = {
            "compositing": FORWARD_FLOPS * of["pairs visited"],
            "compositing backward": BACKWARD_FLOPS * of["pairs visited"],
            "loss": LOSS_FLOPS * 3 * size.width * size.height,
        }
        for stage, operations in work.items():
            rate = operations / of[stage] / 1e6
            shares[f"{stage}, {_threads(n)}"] = {"flops": rate, "of peak": 100 * rate / machine[n]["gflops"]}
        rate = ADAM_BYTES * of["visible"] / of["Adam"] / 1e6
        share = 100 * rate / machine[n]["gigabytes_per_second"]
        shares[f"Adam, {_threads(n)}"] = {"bytes": rate, "of bandwidth": share}
    columns = {
        "GFLOP/s": ("flops", ".1f"),
        "% of the machine's": ("of peak", ".0f"),
        "GB/s": ("bytes", ".1f"),
        "% of its bandwidth": ("of bandwidth", ".0f"),
    }
    about = (
        f"Operations counted: {FORWARD_FLOPS} a visited pair forward, {BACKWARD_FLOPS} backward, {LOSS_FLOPS} a pixel "
        f"and channel of the loss; bytes: {ADAM_BYTES} a Gaussian of Adam, more than 100 % where the caches hold them."
    )
    return [markdown_table("share of the machine", columns, shares), about]


def _whole(figures: Mapping[str, Any]) -> list[str]:
    """Return the paragraphs about growth, voxels and whole runs."""
    growth: dict[str, Figures] = {}
    for of in (of for group in figures["growth"].values() for of in group):
        out = f", {of['hidden']:,.0f} out of it" if of["hidden"] else ""
        growth[f"{of['pixels'] / 1e3:,.0f} thousand pixels, {of['visible']:,.0f} Gaussians in view{out}"] = of
    keyframes = {f"{of['keyframes']:,.0f}": of for of in figures["frames"]}
    voxels = {f"down to level {level} of 0 to 7": of for level, of in figures["voxels"].items()}
    runs = {name: {**of, **of["seconds"]} for name, of in figures["runs"].items()}
    return [
        "## Growth",
        markdown_table("step", {"ms": ("step", ".1f")}, growth),
        "A frame that becomes a keyframe, 320x240, 10,000 Gaussians, 5 steps of 6 views, by the keyframes before it:",
        markdown_table("keyframes", {"ms": ("frame", ".1f")}, keyframes),
        "## Voxels",
        markdown_table("300,000 points, ms per 100,000", VOXELS, voxels),
        "## Whole runs, online",
        markdown_table("scene", RUNS, runs),
    ]


def _threads(n: str) -> str:
    return "1 thread" if n == "1" else f"{n} threads"

"""Formats the figures of a benchmark as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from experiments import Figures, markdown_table

from benchmarks.scene import Size
from benchmarks.step import ADAM_BYTES, BACKWARD_FLOPS, FORWARD_FLOPS, LOSS_FLOPS, STAGES

__all__ = ["report"]


def report(figures: Mapping[str, Any]) -> str:
    """Return the tables of all figures (see `collect` in benchmark.py)."""
    parts = [f"# Benchmark: {figures['device']}, {figures['cores']} cores", *_machine(figures["machine"])]
    for row in figures["steps"]:
        parts += _step(row, figures["machine"])
    if "growth" in figures:
        parts += _growth(figures["growth"], figures["frames"])
    if "voxels" in figures:
        parts += _voxels(figures["voxels"])
    if "runs" in figures:
        parts += _runs(figures["runs"])
    return "\n".join(parts)


def _machine(machine: Mapping[str, Figures]) -> list[str]:
    rows = {_threads(n): of for n, of in machine.items()}
    columns = {"GFLOP/s": ("gflops", ".0f"), "GB/s": ("gigabytes_per_second", ".1f")}
    about = "Float32 on this machine: PyTorch's product of 2048 x 2048 matrices, and a = b + s c beyond the caches."
    return ["", about, "", markdown_table("machine", columns, rows)]


def _step(row: Mapping[str, Any], machine: Mapping[str, Figures]) -> list[str]:
    size, runs = Size(*row["size"]), row["threads"]
    first, last = next(iter(runs.values())), runs[max(runs, key=int)]
    visited, whole = first["pairs visited"], first["pairs of whole tiles"]
    about = (
        f"{visited / 1e6:.2f} million pixel-Gaussian pairs visited, {whole / 1e6:.2f} million over whole tiles; "
        f"{first['visible']:,.0f} Gaussians visible; peak memory of the process {last['peak_memory_mb']:.0f} MB. "
        "Cores at work in a step: "
        + ", ".join(f"{of['cores_had']:.2f} with {_threads(n)}" for n, of in runs.items())
        + "; far fewer than threads where others use the machine."
    )
    lines = ["", f"## {size}", "", about]
    return [*lines, *_compositing(runs, visited, whole), *_stages(runs), *_shares(runs, size, visited, machine)]


def _compositing(runs: Mapping[str, Figures], visited: float, whole: float) -> list[str]:
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
    columns = {
        "ns per pair visited": ("visited", ".2f"),
        "ns per pair of whole tiles": ("whole", ".2f"),
        "times faster than the plain twin": ("twin", ".1f"),
    }
    return ["", markdown_table("compositing", columns, pairs)]


def _stages(runs: Mapping[str, Figures]) -> list[str]:
    first, last = next(iter(runs.values())), runs[max(runs, key=int)]
    columns = {f"{_threads(n)} [ms]": (n, ".2f") for n in runs}
    if len(runs) > 1:
        columns["speed-up"] = ("speed-up", ".2f")
    stages = {
        "**whole step**" if name == "step" else name: {n: of[name] for n, of in runs.items()}
        | {"speed-up": first[name] / last[name]}
        for name in (*STAGES, "step")
    }
    return ["", markdown_table("stage", columns, stages)]


def _shares(runs: Mapping[str, Figures], size: Size, visited: float, machine: Mapping[str, Figures]) -> list[str]:
    shares: dict[str, Figures] = {}
    for n, of in runs.items():
        work = {
            "compositing": FORWARD_FLOPS * visited,
            "compositing backward": BACKWARD_FLOPS * visited,
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
    return ["", markdown_table("share of the machine", columns, shares), "", about]


def _growth(growth: Mapping[str, Sequence[Figures]], frames: Sequence[Figures]) -> list[str]:
    rows: dict[str, Figures] = {}
    for group in growth.values():
        for of in group:
            name = f"{of['pixels'] / 1e3:,.0f} thousand pixels, {of['visible']:,.0f} Gaussians in view"
            if of["hidden"]:
                name += f", {of['hidden']:,.0f} out of it"
            rows[name] = of
    lines = ["", "## Growth", "", markdown_table("step", {"ms": ("step", ".1f")}, rows)]
    about = (
        "A frame that becomes a keyframe, 320x240, 10,000 Gaussians, 5 steps of 6 views, by the keyframes before it:"
    )
    table = {f"{of['keyframes']:,.0f}": of for of in frames}
    return [*lines, "", about, "", markdown_table("keyframes", {"ms": ("frame", ".1f")}, table)]


def _voxels(levels: Mapping[str, Figures]) -> list[str]:
    rows = {f"down to level {level} of 0 to 7": of for level, of in levels.items()}
    columns = {
        "query": ("query", ".1f"),
        "update": ("update", ".1f"),
        "admit: both at once": ("admit", ".1f"),
        "MB": ("megabytes", ".0f"),
    }
    return ["", "## Voxels", "", markdown_table("300,000 points, ms per 100,000", columns, rows)]


def _runs(runs: Mapping[str, Mapping[str, Any]]) -> list[str]:
    columns = {
        "frames": ("frames", ",.0f"),
        "keyframes": ("keyframes", ",.0f"),
        "Gaussians": ("gaussians", ",.0f"),
        "frames per second": ("frames_per_second", ".2f"),
        "compiling [s]": ("compile", ".1f"),
        "waiting for frames [s]": ("read", ".2f"),
        "peak memory [MB]": ("peak_memory_mb", ".0f"),
        "PSNR": ("psnr", ".2f"),
    }
    rows = {name: dict(of) | {k: of["seconds"][k] for k in ("compile", "read")} for name, of in runs.items()}
    return ["", "## Whole runs, online", "", markdown_table("scene", columns, rows)]


def _threads(n: str) -> str:
    return "1 thread" if n == "1" else f"{n} threads"

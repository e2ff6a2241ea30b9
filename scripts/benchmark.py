"""Measure speed and memory on this machine, and print them as Markdown or write Markdown and JSON.

The tables contain the time of a step by stage, its share of the machine's float32 throughput and memory bandwidth, and
the frames per second of whole runs. Every measurement runs in its own process. Figures are medians after a warm-up.

With --quality, they contain instead the held-out PSNR of scenes against processor time at several budgets, by this
version of the program and, with --against, by another one; with --minutes, that of maps made in so much time.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import quality
import step
from ending import documented_ending
from step import SIZES, STAGES, Size
from tables import Figures, command_line, execute, markdown_table, named_scenes, settings_of, write_report
from versions import ROOT, checked_out, this_version

from fields.runtime.process import available_cores
from modp_ti.files.errors import InputError

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


@documented_ending()
def main() -> None:
    """Measure and print the tables. The exit code is 2 for bad input."""
    options = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: scripts/benchmark --quick -o out/benchmark",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    options.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of every run")
    options.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="also write the tables and JSON there")
    options.add_argument("--quick", action="store_true", help="the first size only, and no whole run")
    options.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="default cpu")
    options.add_argument("--scene", action="append", metavar="FILE", help="scene of a whole run (default: the demo)")
    options.add_argument("--repeats", type=int, default=15, help="timed calls a figure (default 15)")
    options.add_argument("--quality", action="store_true", help="held-out PSNR against processor time")
    options.add_argument("--against", metavar="REV", help="for --quality: also run this commit, interleaved")
    options.add_argument(
        "--budgets", type=int, nargs="+", default=[1, 2, 4, 8, 25], metavar="STEPS", help="steps a keyframe of its runs"
    )
    options.add_argument("--runs", type=int, default=1, help="for --quality: runs of each, medians count (default 1)")
    options.add_argument("--minutes", type=float, nargs="+", help="PSNR of `modp-ti run --minutes` with each of these")
    options.add_argument("--measure", help=argparse.SUPPRESS)
    arguments = options.parse_args()
    if arguments.measure:
        print(json.dumps(measure(**json.loads(arguments.measure))))
        return
    scenes = named_scenes(arguments.scene or [str(ROOT / "demo" / "scene.yaml")])
    name = "minutes" if arguments.minutes else "quality" if arguments.quality else "benchmark"
    measures = {"minutes": measure_minutes, "quality": measure_quality, "benchmark": measure_speed}
    text, figures = measures[name](arguments, scenes)
    print(text) if arguments.output is None else write_report(arguments.output, name, text, figures)


def measure_quality(arguments: argparse.Namespace, scenes: Mapping[str, Path]) -> tuple[str, Any]:
    """Measure quality against processor time, and return the tables and their points."""
    settings = {"device": arguments.device, **command_line(arguments.set)}
    for scene in scenes.values():
        settings_of(scene, Path("out"), settings)  # reports bad settings before the first run
    with ExitStack() as held:
        versions = {this_version(): ROOT}
        if arguments.against:
            versions |= [held.enter_context(checked_out(arguments.against))]
        curves = quality.curves(scenes, versions, arguments.budgets, arguments.runs, settings)
    points = {scene: {v: [asdict(p) for p in points] for v, points in of.items()} for scene, of in curves.items()}
    return quality.report(curves), points


def measure_minutes(arguments: argparse.Namespace, scenes: Mapping[str, Path]) -> tuple[str, Any]:
    """Measure the quality of maps made in a given time, and return the table and its figures."""
    settings = {"device": arguments.device, **command_line(arguments.set)}
    for scene, minutes in itertools.product(scenes.values(), arguments.minutes):
        settings_of(scene, Path("out"), {**settings, "minutes": minutes})  # reports bad settings before the first run
    runs = quality.timed(scenes, arguments.minutes, settings)
    return quality.timed_report(runs), runs


def measure_speed(arguments: argparse.Namespace, scenes: Mapping[str, Path]) -> tuple[str, dict[str, Any]]:
    """Measure the machine, steps and whole runs, and return the tables and their figures."""
    device, cores = arguments.device, available_cores()
    with tempfile.TemporaryDirectory() as folder:
        overrides = {"refine.steps": "0", "device": device, **command_line(arguments.set)}
        runs = {
            (name, "run"): settings_of(file, Path(folder) / name, overrides)  # reports bad input now
            for name, file in scenes.items()
            if not arguments.quick
        }
        threads = [cores] if device == "cuda" else sorted({1, cores})
        figures: dict[str, Any] = {"device": device, "cores": cores, "steps": []}
        figures["machine"] = {str(n): in_process("machine", device=device, threads=n) for n in threads}
        for size in SIZES[:1] if arguments.quick else SIZES:
            common = {"device": device, "size": asdict(size), "repeats": arguments.repeats}
            steps = {str(n): in_process("step", **common, threads=n) for n in threads}
            figures["steps"].append({"size": asdict(size), "threads": steps})
        if runs:
            kept = ("frames", "keyframes", "gaussians", "frames_per_second", "peak_memory_mb", "seconds")
            figures["runs"] = {
                name: {key: metrics[key] for key in kept} | {"psnr": metrics["online"]["held_out"]["psnr"]}
                for (name, _), metrics in execute(runs, Path(folder) / "batch").items()
            }
    return report(figures), figures


def in_process(kind: str, **arguments: Any) -> Any:
    """Run one measurement in its own process and return its figures. Raises InputError if it fails."""
    print(f"measuring {kind} {arguments.get('size', '')} ...", file=sys.stderr)
    command = [sys.executable, __file__, "--measure", json.dumps({"kind": kind} | arguments)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise InputError(f"measuring {kind} ended with exit code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def measure(kind: str, **arguments: Any) -> dict[str, float]:
    """Run one measurement in this process."""
    if kind == "machine":
        return step.measure_machine(**arguments)
    return step.measure_step(**arguments | {"size": Size(**arguments["size"])})


def report(figures: Mapping[str, Any]) -> str:
    """Return the tables of all figures (see `measure_speed`)."""
    columns = {"GFLOP/s": ("gflops", ".0f"), "GB/s": ("gigabytes_per_second", ".1f")}
    parts = [
        f"# Benchmark: {figures['device']}, {figures['cores']} cores",
        "Float32 on this machine: PyTorch's product of 2048 x 2048 matrices, and a = b + s c beyond the caches.",
        markdown_table("machine", columns, {_threads(n): of for n, of in figures["machine"].items()}),
    ]
    for row in figures["steps"]:
        parts += [f"## {Size(**row['size'])}", *_step(Size(**row["size"]), row["threads"], figures["machine"])]
    if "runs" in figures:
        runs = {name: {**of, **of["seconds"]} for name, of in figures["runs"].items()}
        parts += ["## Whole runs, online", markdown_table("scene", RUNS, runs)]
    return "\n\n".join(parts)


def _step(size: Size, runs: Mapping[str, Mapping], machine: Mapping[str, Mapping]) -> tuple[str, str]:
    """Return what is said of a step at one size, and its table, given figures and machine by number of threads."""
    first, last = next(iter(runs.values())), runs[max(runs, key=int)]
    at_work = ", ".join(f"{of['cores_had']:.2f} with {_threads(n)}" for n, of in runs.items())
    about = (
        f"{first['pairs visited'] / 1e6:.2f} million pixel-Gaussian pairs visited, {first['visible']:,.0f} Gaussians "
        f"visible; peak memory of the process {last['peak_memory_mb']:.0f} MB. Cores at work in a step: {at_work}; far "
        f"fewer than threads where others use the machine. The share is that of the machine's throughput, counting "
        f"{step.FORWARD_FLOPS} operations a visited pair forward, {step.BACKWARD_FLOPS} backward and {step.LOSS_FLOPS} "
        f"a pixel and channel of the loss; for Adam that of its bandwidth, counting {step.ADAM_BYTES} bytes a Gaussian "
        "(more than 100 % where the caches hold them)."
    )
    work = {  # each stage's work in units of a billion, and which of the machine's figures bounds it
        "compositing": (step.FORWARD_FLOPS * first["pairs visited"], "gflops"),
        "compositing backward": (step.BACKWARD_FLOPS * first["pairs visited"], "gflops"),
        "loss": (step.LOSS_FLOPS * 3 * size.width * size.height, "gflops"),
        "Adam": (step.ADAM_BYTES * first["visible"], "gigabytes_per_second"),
    }
    rows: dict[str, Figures] = {}
    for name in (*STAGES, "step"):
        row: dict[str, float | None] = {n: of[name] for n, of in runs.items()}
        row["speed-up"] = first[name] / last[name] if len(runs) > 1 else None
        if name in work:
            amount, bound = work[name]
            row |= {f"share {n}": amount / of[name] / 1e6 / machine[n][bound] * 100 for n, of in runs.items()}
        rows["**whole step**" if name == "step" else name] = row
    columns = {f"{_threads(n)} [ms]": (n, ".2f") for n in runs} | {"speed-up": ("speed-up", ".2f")}
    columns |= {f"share, {_threads(n)} [%]": (f"share {n}", ".0f") for n in runs}
    return about, markdown_table("stage", columns, rows)


def _threads(n: str) -> str:
    return "1 thread" if n == "1" else f"{n} threads"


if __name__ == "__main__":
    main()

"""Measure speed and memory on this machine, and print them as Markdown or write Markdown and JSON.

The tables contain: the time of a step by stage and by pixel-Gaussian pair; its share of the machine's float32
throughput and memory bandwidth; and the frames per second of whole runs. Every measurement runs in its own process.
Figures are medians after a warm-up.

With --quality, they contain instead the held-out PSNR of scenes against processor time at several budgets, by this
version of the program and, with --against, by another one.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import quality
from ending import documented_ending
from step import (
    ADAM_BYTES,
    BACKWARD_FLOPS,
    FORWARD_FLOPS,
    LOSS_FLOPS,
    SIZES,
    STAGES,
    Size,
    measure_machine,
    measure_step,
)
from tables import Figures, command_line, execute, markdown_table, named_scenes, settings_of, write_report

from fields.runtime.parallel import available_cores
from modp_ti.files.errors import InputError

DEMO = Path(__file__).resolve().parent.parent / "demo" / "scene.yaml"
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
    options.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="also write benchmark.md and .json there")
    options.add_argument("--quick", action="store_true", help="the first size only, and no whole run")
    options.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="default cpu")
    options.add_argument("--scene", action="append", metavar="FILE", help="scene of a whole run (default: the demo)")
    options.add_argument("--repeats", type=int, default=15, help="timed calls a figure (default 15)")
    options.add_argument("--quality", action="store_true", help="held-out PSNR against processor time; needs -o")
    options.add_argument("--against", metavar="REV", help="for --quality: also run this commit, interleaved")
    options.add_argument(
        "--budgets", type=int, nargs="+", default=[1, 2, 4, 8, 25], metavar="STEPS", help="steps a keyframe of its runs"
    )
    options.add_argument(
        "--against-budgets", type=int, nargs="+", metavar="STEPS", help="those of the other commit (default: the same)"
    )
    options.add_argument("--runs", type=int, default=1, help="for --quality: runs of each, medians count (default 1)")
    options.add_argument("--measure", help=argparse.SUPPRESS)
    arguments = options.parse_args()
    if arguments.measure:
        print(json.dumps(measure(**json.loads(arguments.measure))))
    elif arguments.quality:
        if arguments.output is None:
            options.error("--quality writes a plot: give a folder with -o")
        if arguments.against_budgets and not arguments.against:
            options.error("--against-budgets are those of another commit: give it with --against")
        measure_quality(arguments)
    else:
        figures = collect(arguments)
        if arguments.output is None:
            print(report(figures))
        else:
            write_report(arguments.output, "benchmark", report(figures), figures)


def measure_quality(arguments: argparse.Namespace) -> None:
    """Measure quality against processor time, and write quality.md, quality.json and quality.png."""
    scenes = named_scenes(arguments.scene or [str(DEMO)])
    settings = {"device": arguments.device, **command_line(arguments.set)}
    for scene in scenes.values():
        settings_of(scene, arguments.output, settings)  # reports bad settings before the first run
    with ExitStack() as held:
        programs = {quality.this_program(): arguments.budgets}
        if arguments.against:
            other = held.enter_context(quality.against(arguments.against))
            programs[other] = arguments.against_budgets or arguments.budgets
        curves = quality.curves(scenes, programs, arguments.runs, settings)
    figures = {
        scene: {program: [asdict(point) for point in points] for program, points in of.items()}
        for scene, of in curves.items()
    }
    write_report(arguments.output, "quality", quality.report(curves), figures)
    quality.plot(curves, arguments.output / "quality.png")


def collect(arguments: argparse.Namespace) -> dict[str, Any]:
    """Run all measurements and return the figures by kind."""
    device, cores = arguments.device, available_cores()
    with tempfile.TemporaryDirectory() as folder:
        overrides = {"refine.steps": "0", "device": device, **command_line(arguments.set)}
        runs = {
            (name, "run"): settings_of(file, Path(folder) / name, overrides)  # reports bad input now
            for name, file in named_scenes(arguments.scene or [str(DEMO)]).items()
            if not arguments.quick
        }
        threads = [cores] if device == "cuda" else sorted({1, cores})
        figures: dict[str, Any] = {"device": device, "cores": cores, "steps": []}
        figures["machine"] = {str(n): in_process("machine", device=device, threads=n) for n in threads}
        for size in SIZES[:1] if arguments.quick else SIZES:
            common = {"device": device, "size": asdict(size), "repeats": arguments.repeats}
            steps = {str(n): in_process("step", **common, threads=n, twin=size == SIZES[0] and n == 1) for n in threads}
            figures["steps"].append({"size": asdict(size), "threads": steps})
        if runs:
            kept = ("frames", "keyframes", "gaussians", "frames_per_second", "peak_memory_mb", "seconds")
            figures["runs"] = {
                name: {key: metrics[key] for key in kept} | {"psnr": metrics["online"]["held_out"]["psnr"]}
                for (name, _), metrics in execute(runs, Path(folder) / "batch").items()
            }
        return figures


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
        return measure_machine(**arguments)
    arguments["size"] = Size(**arguments["size"])
    return measure_step(**arguments)


# ---- tables ----------------------------------------------------------------------------------------------------------


def report(figures: Mapping[str, Any]) -> str:
    """Return the tables of all figures (see `collect`)."""
    columns = {"GFLOP/s": ("gflops", ".0f"), "GB/s": ("gigabytes_per_second", ".1f")}
    parts = [
        f"# Benchmark: {figures['device']}, {figures['cores']} cores",
        "Float32 on this machine: PyTorch's product of 2048 x 2048 matrices, and a = b + s c beyond the caches.",
        markdown_table("machine", columns, {_threads(n): of for n, of in figures["machine"].items()}),
    ]
    for row in figures["steps"]:
        parts += _step(Size(**row["size"]), row["threads"], figures["machine"])
    if "runs" in figures:
        runs = {name: {**of, **of["seconds"]} for name, of in figures["runs"].items()}
        parts += ["## Whole runs, online", markdown_table("scene", RUNS, runs)]
    return "\n\n".join(parts)


def _step(size: Size, runs: Mapping[str, Mapping], machine: Mapping[str, Mapping]) -> Sequence[str]:
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
    shares: dict[str, Figures] = {}
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
    of_shares = {
        "GFLOP/s": ("flops", ".1f"),
        "% of the machine's": ("of peak", ".0f"),
        "GB/s": ("bytes", ".1f"),
        "% of its bandwidth": ("of bandwidth", ".0f"),
    }
    counted = (
        f"Operations counted: {FORWARD_FLOPS} a visited pair forward, {BACKWARD_FLOPS} backward, {LOSS_FLOPS} a pixel "
        f"and channel of the loss; bytes: {ADAM_BYTES} a Gaussian of Adam, more than 100 % where the caches hold them."
    )
    return (
        f"## {size}",
        about,
        markdown_table("compositing", of_pairs, pairs),
        markdown_table("stage", of_stages, stages),
        markdown_table("share of the machine", of_shares, shares),
        counted,
    )


def _threads(n: str) -> str:
    return "1 thread" if n == "1" else f"{n} threads"


if __name__ == "__main__":
    main()

"""Measure speed and memory on this machine, and print them as Markdown or write Markdown and JSON.

The tables contain: the time of a step by stage and by pixel-Gaussian pair; its share of the machine's float32
throughput and memory bandwidth; how it grows; the cost of the voxels; and the frames per second of whole runs. Every
measurement runs in its own process. Figures are medians after a warm-up.

With --quality, they contain instead the held-out PSNR of scenes against processor time at several budgets, by this
version of the program and, with --against, by another one. With --scale N, they contain the time, memory and quality of
a map of N copies of a scene side by side.
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

from benchmarks import quality, quality_report
from benchmarks.report import report, world_report
from ending import documented_ending
from experiments import Job, command_line, execute, named_scenes, parser, write_report

from fields.runtime.parallel import available_cores
from modp_ti.files.errors import InputError

# (width, height, Gaussians in view) of a phone's frame, a webcam's frame, and full detail.
SIZES = [(270, 480, 12_500), (640, 480, 100_000), (1280, 720, 500_000)]
DEMO = Path(__file__).resolve().parent.parent / "demo" / "scene.yaml"


@documented_ending()
def main() -> None:
    """Measure and print the tables. The exit code is 2 for bad input."""
    options = parser(__doc__, "scripts/benchmark --quick -o out/benchmark")
    options.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="also write benchmark.md and .json there")
    options.add_argument("--quick", action="store_true", help="the first size only; no growth, no voxels, no whole run")
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
    options.add_argument("--scale", type=int, metavar="N", help="a map of N copies of the scene, side by side")
    options.add_argument("--measure", help=argparse.SUPPRESS)
    arguments = options.parse_args()
    if arguments.measure:
        print(json.dumps(measure(**json.loads(arguments.measure))))
        return
    if arguments.quality:
        if arguments.output is None:
            options.error("--quality writes a plot: give a folder with -o")
        if arguments.against_budgets and not arguments.against:
            options.error("--against-budgets are those of another commit: give it with --against")
        measure_quality(arguments)
        return
    if arguments.scale:
        figures = collect_scale(arguments)
        text = world_report(figures)
    else:
        figures = collect(arguments)
        text = report(figures)
    if arguments.output is None:
        print(text)
    else:
        write_report(arguments.output, "benchmark", text, figures)


def measure_quality(arguments: argparse.Namespace) -> None:
    """Measure quality against processor time, and write quality.md, quality.json and quality.png."""
    scenes = named_scenes(arguments.scene or [str(DEMO)])
    settings = {"device": arguments.device, **command_line(arguments.set)}
    for name, scene in scenes.items():
        Job(name, scene, arguments.output, settings).check()
    with ExitStack() as held:
        programs = {quality.this_program(): arguments.budgets}
        if arguments.against:
            other = held.enter_context(quality.against(arguments.against))
            programs[other] = arguments.against_budgets or arguments.budgets
        runs = quality.curves(scenes, programs, arguments.runs, settings, arguments.output / "runs")
    figures = {
        scene: {program: [asdict(point) for point in points] for program, points in of.items()}
        for scene, of in runs.items()
    }
    write_report(arguments.output, "quality", quality_report.report(runs), figures)
    quality_report.plot(runs, arguments.output / "quality.png")


def collect_scale(arguments: argparse.Namespace) -> dict[str, Any]:
    """Map copies of the first scene side by side, and return the figures."""
    scene = (arguments.scene or [str(DEMO)])[0]
    settings = [f"{key}={value}" for key, value in {"device": arguments.device, **command_line(arguments.set)}.items()]
    with tempfile.TemporaryDirectory() as folder:
        return in_process("scale", scene=scene, copies=arguments.scale, settings=settings, folder=folder)


def collect(arguments: argparse.Namespace) -> dict[str, Any]:
    """Run all measurements and return the figures by kind."""
    device, repeats = arguments.device, arguments.repeats
    runs = (arguments.scene or [str(DEMO)], device, command_line(arguments.set))
    if not arguments.quick:
        planned_runs(*runs, Path())  # reports bad input now instead of after minutes of measuring
    cores = available_cores()
    threads = [cores] if device == "cuda" else sorted({1, cores})
    on = {"device": device, "threads": cores}
    figures: dict[str, Any] = {"device": device, "cores": cores, "steps": []}
    figures["machine"] = {str(n): in_process("machine", device=device, threads=n) for n in threads}
    for size in SIZES[:1] if arguments.quick else SIZES:
        row: dict[str, Any] = {"size": size, "threads": {}}
        for n in threads:
            twin = size == SIZES[0] and n == 1
            row["threads"][str(n)] = in_process("step", device=device, threads=n, size=size, repeats=repeats, twin=twin)
        figures["steps"].append(row)
    if arguments.quick:
        return figures
    figures["growth"] = in_process("growth", **on, repeats=repeats)
    figures["frames"] = in_process("frames", **on)
    figures["voxels"] = in_process("voxels", **on)
    figures["runs"] = measure_runs(*runs)
    return figures


def in_process(kind: str, **arguments: Any) -> Any:
    """Run one measurement in its own process and return its figures. Raises InputError if it fails."""
    job = json.dumps({"kind": kind} | arguments)
    print(f"measuring {kind} {arguments.get('size', '')} ...", file=sys.stderr)
    command = [sys.executable, __file__, "--measure", job]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise InputError(f"measuring {kind} ended with exit code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def measure(kind: str, **arguments: Any) -> Any:
    """Run one measurement in this process."""
    from benchmarks import growth, machine, scale, step, voxels
    from benchmarks.scene import Size

    if "size" in arguments:
        arguments["size"] = Size(*arguments["size"])
    if kind == "voxels":
        return {level: voxels.measure_voxels(**arguments, level=level) for level in voxels.LEVELS}
    kinds = {
        "machine": machine.measure_machine,
        "step": step.measure_step,
        "growth": growth.measure_growth,
        "frames": growth.measure_frames,
        "scale": scale.measure_world,
    }
    return kinds[kind](**arguments)


def planned_runs(scenes: Sequence[str], device: str, settings: Mapping[str, str], folder: Path) -> list[Job]:
    """Return a job for every scene file, without refinement, with output folders named after the scenes.

    Args:
        scenes: Scene files.
        device: "cpu" or "cuda".
        settings: Overrides by key.
        folder: Parent of the output folders.

    Raises:
        InputError: If a scene cannot be run.
    """
    overrides = {"refine.steps": "0", "device": device, **settings}
    jobs = [
        Job(f"whole run of {name}", scene, folder / name, overrides) for name, scene in named_scenes(scenes).items()
    ]
    for job in jobs:
        job.check()
    return jobs


def measure_runs(scenes: Sequence[str], device: str, settings: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """Run the scenes and return their figures of metrics.json by the scene's name. Raises InputError if a run fails."""
    with tempfile.TemporaryDirectory() as folder:
        jobs = planned_runs(scenes, device, settings, Path(folder))
        results = execute(jobs)
    kept = ("frames", "keyframes", "gaussians", "frames_per_second", "peak_memory_mb", "seconds", "breakdown_percent")
    return {
        job.folder.name: {key: metrics[key] for key in kept} | {"psnr": metrics["online"]["held_out"]["psnr"]}
        for job, metrics in zip(jobs, results, strict=True)
    }


if __name__ == "__main__":
    main()

"""Check and measure the program on this machine's GPU in eight minutes at most, and print Markdown.

The tests of the GPU's kernels come first. The table contains, for a view of a step, the calls by which the host starts
kernels and PyTorch's operations, the host's time, and the time of the whole step; the frames per second of online runs;
and whether two runs write the same bytes. What the time does not suffice for is left out. --device vulkan or cpu tries
the command where there is no card.

The exit code is 1 if a test fails or two runs differ.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmark import in_process
from ending import documented_ending
from same_bytes import DATA, digest
from step import SIZES, Size
from tables import execute, markdown_table, settings_of, write_report
from versions import ROOT, this_version

from fields.runtime.engine import engine
from fields.runtime.process import available_cores

# The recording of the runs, if it is there, with the scales of its 640x480 pixels; and otherwise the demo.
KITCHEN = f"source: {{path: {DATA}/redkitchen/images, step: 5, holdout: 8}}\ntracker: {{kind: colmap, path: "
KITCHEN += f"{DATA}/redkitchen/sparse/0}}\noutput: out\n"
SCALES = {"redkitchen": (0.5, 0.5, 1.0), "the demo": (0.5, 0.5, 1.0)}
LAST = 60.0  # no run begins so late [s]
STEP = {"calls": ("calls", ".0f"), "host [ms]": ("host", ".3f"), "step [ms]": ("step", ".2f")}
STEP |= {"peak memory [MB]": ("peak_memory_mb", ".0f")}
RUN = {"frames per second": ("frames_per_second", ".2f"), "held-out PSNR": ("psnr", ".2f")}
RUN |= {"Gaussians": ("gaussians", ",.0f"), "compiling [s]": ("compile", ".1f")}


@documented_ending()
def main() -> None:
    """Run the tests, measure, and print the tables."""
    options = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: MODP_ENGINE=quadrants scripts/gpu_check -o out/gpu",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    options.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="also write gpu_check.md and .json there")
    options.add_argument("--device", choices=("cuda", "vulkan", "cpu"), default="cuda", help="default cuda")
    options.add_argument("--minutes", type=float, default=8.0, help="time for all of it (default 8)")
    options.add_argument("--quick", action="store_true", help="no tests, the first size, and few frames of each run")
    arguments = options.parse_args()
    end = time.monotonic() + 60.0 * arguments.minutes
    figures: dict[str, Any] = {"version": this_version(), "engine": str(engine()), "device": arguments.device}
    figures["tests"] = "not run" if arguments.quick else run_tests(end)
    common = {"device": arguments.device, "threads": available_cores(), "repeats": 15}
    figures["steps"] = {
        str(size): in_process("step", size=asdict(size), **common)
        for size in (Size(96, 64, 300),) * arguments.quick or SIZES
        if time.monotonic() < end
    }
    with tempfile.TemporaryDirectory() as folder:
        figures |= measure_runs(Path(folder), arguments.device, arguments.quick, end)
    text = report(figures)
    print(text) if arguments.output is None else write_report(arguments.output, "gpu_check", text, figures)
    if "failed" in figures["tests"] or not figures["same_bytes"]:
        raise SystemExit(1)


def run_tests(end: float) -> str:
    """Run the tests of the GPU's kernels, and return the last line of pytest."""
    command = [sys.executable, "-m", "pytest", "-q", "-n0", "-p", "no:randomly", "tests/pipelines/gpu"]
    try:
        left = max(end - time.monotonic(), 1.0)
        done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False, timeout=left)
    except subprocess.TimeoutExpired:
        return "failed: did not end in time"
    print(done.stdout, file=sys.stderr)
    return done.stdout.strip().splitlines()[-1] if done.returncode == 0 else "failed: see above"


def measure_runs(folder: Path, device: str, quick: bool, end: float) -> dict[str, Any]:
    """Map a recording twice at half its size and once at its full size, and return the figures and `same_bytes`."""
    name, scene = "the demo", ROOT / "demo" / "scene.yaml"
    if DATA.exists():
        name, scene = "redkitchen", folder / "scene.yaml"
        scene.write_text(KITCHEN)
    rows, files = {}, []
    for i, scale in enumerate(SCALES[name]):
        if time.monotonic() > end - LAST:
            break
        settings = {"device": device, "refine.steps": "0", "source.scale": scale}
        settings |= {"source.stop": "40"} if quick else {}
        config = settings_of(scene, folder / str(i), settings)
        [metrics] = execute({(name, str(i)): config}, folder / "batch").values()
        row = {key: metrics[key] for key in ("frames_per_second", "gaussians")}
        row |= {"compile": metrics["seconds"]["compile"], "psnr": metrics["online"]["held_out"]["psnr"]}
        rows[f"{name}, scale {scale}{', again' if i == 1 else ''}"] = row
        files.append([digest(config.output / file) for file in ("splats.ply", "trajectory.txt")])
    return {"runs": rows, "same_bytes": len(files) < 2 or files[0] == files[1]}


def report(figures: dict[str, Any]) -> str:
    """Return the tables of all figures."""
    return "\n\n".join(
        [
            f"# GPU check: {figures['device']}, {figures['engine']}, version {figures['version']}",
            f"Tests of the GPU's kernels: {figures['tests']}.",
            markdown_table("a view of a step", STEP, figures["steps"]),
            markdown_table("online run", RUN, figures["runs"]),
            f"Two runs write the same bytes: {'yes' if figures['same_bytes'] else 'NO'}.",
        ]
    )


if __name__ == "__main__":
    main()

"""Assemble the GPU's kernels for NVIDIA's architectures, on a machine without a GPU, and print tables as Markdown.

Each installed engine compiles the kernels of the online mapper on a stand-in for the CUDA driver, which keeps their PTX
and their launches. NVIDIA's ptxas assembles them as the driver does on a card. The tables contain registers, spills,
shared memory and the occupancy of each kernel; instructions per Gaussian in compositing; and, from these, estimates of
the time of a step. The tools are the CUDA toolkit's if they are on PATH, and are fetched from PyPI otherwise.

The exit code is 1 if a kernel does not assemble, or a compositing kernel spills.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path

from ending import documented_ending
from gpu_kernels.estimate import measure_work
from gpu_kernels.occupancy import ARCHITECTURES
from gpu_kernels.survey import survey
from gpu_kernels.tables import report
from gpu_kernels.toolkit import version
from step import Size
from tables import write_report

from fields.runtime.engine import ENGINES
from modp_ti.files.errors import InputError

# (width, height, Gaussians in view) of a phone's frame, and full detail.
SIZES = [(270, 480, 12_500), (1280, 720, 500_000)]


@documented_ending()
def main() -> None:
    """Survey the kernels and print the tables."""
    options = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: scripts/gpu_report --arch 90 -o out/gpu",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    options.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="also write gpu_report.md and .json there")
    options.add_argument(
        "--engine", action="append", choices=list(ENGINES), help="an engine (default: all that are installed)"
    )
    options.add_argument(
        "--arch", action="append", type=int, choices=list(ARCHITECTURES), help="an architecture (default: all)"
    )
    arguments = options.parse_args()
    engines = arguments.engine or [name for name in ENGINES if find_spec(name) is not None]
    for name in engines:
        if find_spec(name) is None:
            raise InputError(f"{name} is not installed: pip install {name}")
    versions = f"ptxas {version('ptxas')}, nvdisasm {version('nvdisasm')}."
    surveys = []
    for name in engines:
        for capability in arguments.arch or ARCHITECTURES:
            print(f"compiling with {name} for sm_{capability} ...", file=sys.stderr)
            surveys.append(survey(name, ARCHITECTURES[capability]))
    text = report(surveys, [measure_work(Size(*size)) for size in SIZES], versions)
    if arguments.output is None:
        print(text)
    else:
        write_report(arguments.output, "gpu_report", text, [asdict(found) for found in surveys])
    failures = [failure for found in surveys for failure in found.failures]
    for failure in failures:
        print("error:", failure, file=sys.stderr)
    if failures:
        raise SystemExit(1)


if __name__ == "__main__":
    main()

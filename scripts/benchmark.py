"""Times of the kernels and of one optimisation step, and the cost of the voxels, as Markdown tables.

A scene of Gaussians spread over depths of 2 to 6 units stands for a map. Medians of repeated calls after a warm-up.
Per-pair times come from one thread, the step and the voxels from all of them. The voxels take 300,000 points in random
order on the walls of a room that is 80 coarsest cells wide.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np


def main() -> None:
    """Measure in one process a thread count, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="480x270", help="pixels, width x height (default 480x270)")
    parser.add_argument("--gaussians", type=int, default=12_500, help="number of Gaussians (default 12500)")
    parser.add_argument("--repeats", type=int, default=15, help="timed calls a figure (default 15)")
    parser.add_argument("--json", help="also write all figures to this file")
    parser.add_argument("--threads", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--voxels", type=int, metavar="LEVEL", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    width, height = (int(v) for v in arguments.size.split("x"))
    if arguments.voxels is not None:
        print(json.dumps(measure_voxels(arguments.voxels, arguments.threads)))
        return
    if arguments.threads:
        print(json.dumps(measure(width, height, arguments.gaussians, arguments.threads, arguments.repeats)))
        return
    cores = len(os.sched_getaffinity(0))
    runs = {n: _in_process(arguments, n) for n in sorted({1, cores})}
    voxels = {level: _in_process(arguments, cores, "--voxels", str(level)) for level in (3, 7)}
    print(report(runs, cores, width, height, arguments.gaussians))
    print(report_voxels(voxels))
    if arguments.json:
        with open(arguments.json, "w", encoding="utf-8") as file:
            figures = {str(n): figures for n, figures in runs.items()}
            figures |= {f"voxels, level {level}": of_level for level, of_level in voxels.items()}
            json.dump(figures, file, indent=2)


def _in_process(arguments: argparse.Namespace, threads: int, *more: str) -> dict[str, float]:
    command = [sys.executable, __file__, "--size", arguments.size, "--gaussians", str(arguments.gaussians)]
    command += ["--repeats", str(arguments.repeats), "--threads", str(threads), *more]
    print(f"measuring with {threads} thread(s) {' '.join(more)} ...", file=sys.stderr)
    result = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(result.stdout.splitlines()[-1])


def measure(width: int, height: int, count: int, threads: int, repeats: int) -> dict[str, float]:
    """Figures of one thread count: milliseconds by stage, pairs, and nanoseconds a pair."""
    from fields.backend import initialise
    from fields.camera import PinholeCamera
    from fields.gaussians import GaussianField
    from fields.keyframes import KeyframeStore
    from fields.tiles import TILE_PIXELS, TILE_WIDTH
    from fields.tracked_frame import SparsePoints, TrackedFrame
    from pipelines.compositing_reference import ReferenceCompositing
    from pipelines.optimisation import MapOptimiser
    from pipelines.rendering import Renderer
    from pipelines.settings import MappingSettings

    initialise("cpu", threads)
    rng = np.random.default_rng(0)
    camera = PinholeCamera(0.85 * width, 0.85 * width, width / 2, height / 2, width, height)
    depth = rng.uniform(2.0, 6.0, count)
    pixels = rng.uniform((0, 0), (width, height), (count, 2))
    # As dense as a map gets: about one Gaussian for every ten pixels at 480x270 and 12,500.
    size = 0.5 * np.sqrt(width * height / count) * depth / camera.focal
    gaussians = GaussianField()
    gaussians.append(
        position=camera.unproject(pixels, depth),
        log_scale=np.log(size)[:, None] + rng.normal(0.0, 0.5, (count, 3)),
        quaternion=rng.normal(size=(count, 4)),
        opacity_logit=rng.normal(0.0, 1.5, count),
        sh=rng.normal(0.0, 0.5, (count, 1, 3)),
    )
    settings = MappingSettings()
    renderer = Renderer(gaussians, width, height)
    optimiser = MapOptimiser(gaussians, renderer, settings)
    image = rng.random((height, width, 3), dtype=np.float32)
    frame = TrackedFrame(0, 0.0, "noise", image, camera, np.eye(4), SparsePoints())
    store = KeyframeStore()
    view = store.append(frame)

    def milliseconds(call: Callable[[], object]) -> float:
        call()
        times = []
        for _ in range(repeats):
            start = time.perf_counter()
            call()
            times.append(time.perf_counter() - start)
        return 1e3 * float(np.median(times))

    figures: dict[str, float] = {}
    optimiser.compare(view, 1.0)
    optimiser.loss.backward(0.2)
    figures["projection"] = milliseconds(renderer.projection.forward)
    figures["binning"] = milliseconds(renderer.binning.forward)
    figures["compositing"] = milliseconds(renderer.compositing.forward)
    figures["loss"] = milliseconds(lambda: (optimiser.loss.forward(), optimiser.loss.backward(0.2)))
    figures["compositing backward"] = milliseconds(renderer.compositing.backward)
    reference = ReferenceCompositing(renderer.view, renderer.projected, renderer.pairs, renderer.images)
    figures["reference"] = milliseconds(reference.forward)
    figures["reference backward"] = milliseconds(reference.backward)

    pairs = renderer.pairs.count
    rows = renderer.pairs.rows_to_numpy()
    visited = int(((rows >> 16) - (rows & 0xFFFF)).sum()) * TILE_WIDTH
    figures["pixel pairs of whole tiles"] = pairs * TILE_PIXELS
    figures["pixel pairs visited"] = visited
    figures["visible"] = renderer.projected.count

    rates = optimiser.rates(1.0)

    def backward_and_adam() -> None:
        renderer.projection.backward()
        optimiser.adam.step(rates)

    figures["projection backward, Adam"] = milliseconds(backward_and_adam)
    figures["step"] = milliseconds(lambda: optimiser.step(store, [0], rates, pose_rate=0.0))
    return figures


VOXEL_POINTS, VOXEL_BATCHES, ROOM = 100_000, 3, 80.0


def measure_voxels(level: int, threads: int) -> dict[str, float]:
    """Milliseconds per 100,000 points at a level of the voxels, and megabytes that 300,000 points take."""
    from fields.backend import initialise
    from fields.occupancy import OccupancyVoxels

    initialise("cpu", threads)
    rng = np.random.default_rng(0)
    points = rng.uniform(-ROOM / 2, ROOM / 2, (VOXEL_BATCHES, VOXEL_POINTS, 3))
    wall = rng.integers(0, 6, points.shape[:2])
    np.put_along_axis(points, (wall // 2)[..., None], ((wall % 2) - 0.5)[..., None] * ROOM, axis=2)
    size = 0.5**level
    times: dict[str, list[float]] = {"query": [], "update": [], "admit": []}

    def timed(name: str, call: Callable[[], object]) -> None:
        start = time.perf_counter()
        call()
        times[name].append(time.perf_counter() - start)

    def compiled() -> OccupancyVoxels:
        voxels = OccupancyVoxels()
        voxels.query(np.zeros((0, 3)), size)
        voxels.admit(np.zeros((0, 3)), size)
        return voxels

    voxels = compiled()
    before = _resident_mb()
    for batch in points:
        timed("query", lambda batch=batch: voxels.query(batch, size))
        timed("update", lambda batch=batch: voxels.update(batch, size))
    megabytes = _resident_mb() - before
    voxels = compiled()
    for batch in points:
        timed("admit", lambda batch=batch: voxels.admit(batch, size))
    return {name: 1e3 * float(np.median(of)) for name, of in times.items()} | {"megabytes": megabytes}


def _resident_mb() -> float:
    """Memory of this process that is in use now (Linux; elsewhere not a number)."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:
        return float("nan")


def report_voxels(levels: dict[int, dict[str, float]]) -> str:
    """The Markdown table of the voxels' figures by level."""
    lines = [
        "",
        "| voxels, 300,000 points, ms per 100,000 | query | update | admit: both at once | MB |",
        "|---|---|---|---|---|",
    ]
    for level, of in levels.items():
        name = f"down to level {level} of 0 to 7"
        lines.append(f"| {name} | {of['query']:.1f} | {of['update']:.1f} | {of['admit']:.1f} | {of['megabytes']:.0f} |")
    return "\n".join(lines)


def report(runs: dict[int, dict[str, float]], cores: int, width: int, height: int, count: int) -> str:
    """The Markdown tables of the figures by thread count."""
    one, all_cores = runs[1], runs[cores]
    visited, whole = one["pixel pairs visited"], one["pixel pairs of whole tiles"]
    lines = [
        f"## {width}x{height} pixels, {count:,} Gaussians, {cores} cores",
        "",
        f"{visited / 1e6:.2f} million pixel-Gaussian pairs visited, {whole / 1e6:.2f} million over whole tiles.",
        "",
        "| compositing, one thread | ns per pair visited | ns per pair of whole tiles | plain twin | ratio |",
        "|---|---|---|---|---|",
    ]
    for name in ("compositing", "compositing backward"):
        plain = one[name.replace("compositing", "reference")]
        lines.append(
            f"| {name.replace('compositing', '').strip() or 'forward'} | {1e6 * one[name] / visited:.2f} "
            f"| {1e6 * one[name] / whole:.2f} | {1e6 * plain / whole:.2f} ns of whole tiles | {plain / one[name]:.1f} |"
        )
    lines += ["", f"| stage | 1 thread [ms] | {cores} threads [ms] | speed-up |", "|---|---|---|---|"]
    stages = ("projection", "binning", "compositing", "loss", "compositing backward", "projection backward, Adam")
    for name in (*stages, "step"):
        a, b = one[name], all_cores[name]
        lines.append(f"| {'**whole step**' if name == 'step' else name} | {a:.2f} | {b:.2f} | {a / b:.2f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()

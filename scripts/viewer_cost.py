"""Measure the viewer's cost: CPU time with and without it, in alternating blocks of one process.

A map of the demo's first frames is refined in blocks of steps. Every other block runs with the viewer, with a real
browser in each of its modes and without one. The time of the viewer's threads counts; that of the browser does not. The
script prints the median ratio of neighbouring blocks next to the viewer's own estimate.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
from ending import documented_ending
from screenshot import choose_mode, missing, open_page

from fields.runtime.backend import initialise
from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import ViewSettings
from modp_ti.engine.build import build_mapper
from modp_ti.engine.live_viewer import LiveViewer
from modp_ti.engine.mapper import Mapper
from modp_ti.files.errors import InputError
from modp_ti.inputs.trackers import open_tracker
from modp_ti.outputs.viewer.modes import MODES
from pipelines.settings import RefineSettings

DEMO = Path(__file__).resolve().parent.parent / "demo" / "scene.yaml"
CLOSED = "no browser"
# Delay before the clock is read at the end of a block, for pending messages of the viewer [s].
SETTLE = 0.3


class Turns:
    """Observes a refinement, enables the viewer in every other block of steps and times the blocks.

    Its `clock` serves as the viewer's clock. It returns the CPU time of the blocks with the viewer.
    """

    def __init__(self, block: int) -> None:
        self.block = block
        self.viewer: LiveViewer | None = None
        self.seconds: dict[bool, list[float]] = {False: [], True: []}
        self._with = False
        self._before = 0.0  # of all finished blocks with the viewer
        self._began = time.process_time()

    def clock(self) -> float:
        return self._before + (time.process_time() - self._began if self._with else 0.0)

    def step(self, step: int, psnr: float) -> None:
        if self._with:
            self.viewer.on_step("refining", step, step, psnr)
        if step % self.block:
            return
        time.sleep(SETTLE)
        taken = time.process_time() - self._began
        self.seconds[self._with].append(taken)
        self._before += taken if self._with else 0.0
        self._with = not self._with
        self._began = time.process_time()

    def cost(self) -> list[float]:
        """Return the extra time of each block with the viewer, relative to the mean of its neighbours [%]."""
        without, seen = self.seconds[False], self.seconds[True]
        return [100 * (s / (0.5 * (a + b)) - 1) for s, a, b in zip(seen, without, without[1:], strict=False)]


def measure(mapper: Mapper, mode: str, block: int, pairs: int) -> tuple[list[float], float]:
    """Return the cost of each block in this mode, and the viewer's own estimate, both in percent."""
    turns = Turns(block)
    viewer = turns.viewer = LiveViewer(ViewSettings(port=0), print, turns.clock)
    try:
        viewer.begin(mapper, len(mapper.frames))
        with nullcontext() if mode == CLOSED else open_page(viewer.url) as page:
            if mode not in (CLOSED, MODES[0]):
                choose_mode(page, mode)
            refine(mapper, block * (2 * pairs + 1), turns.step)
        return turns.cost(), 100 * viewer.cost / max(turns.clock(), 1e-9)
    finally:
        viewer.close()


def refine(mapper: Mapper, steps: int, progress: Callable[[int, float], None] | None = None) -> None:
    """Run refinement steps that hardly change the map, so that all blocks have the same work."""
    settings = RefineSettings(views=1, min_contribution=0.0, position_decay=1.0, scale_decay=1.0)
    mapper.refine(steps, settings, progress)


@documented_ending()
def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=12, help="of the demo that are mapped (default 12)")
    parser.add_argument("--block", type=int, default=60, help="steps of a block (default 60)")
    parser.add_argument("--pairs", type=int, default=8, help="blocks with the viewer, in each mode (default 8)")
    parser.add_argument("--mode", action="append", choices=(CLOSED, *MODES), help="only this one; repeatable")
    arguments = parser.parse_args()
    modes = arguments.mode or [CLOSED, *MODES]
    if modes != [CLOSED] and missing():
        raise InputError(missing())
    initialise("cpu", 1)
    config = load_scene(DEMO)
    config = load_scene(DEMO, [f"source.stop={arguments.frames * config.source.step}"])
    frames = list(open_tracker(config))
    mapper = build_mapper(config, frames[0].camera)
    for frame in frames:
        mapper.add(frame)
    refine(mapper, arguments.block)  # compiles
    print(f"{len(mapper.pipeline.gaussians):,} Gaussians, {len(mapper.pipeline.keyframes)} keyframes")
    print("| mode | processor time, median of blocks | quartiles | by the viewer's own account |\n|---|---|---|---|")
    for mode in modes:
        percent, believed = measure(mapper, mode, arguments.block, arguments.pairs)
        low, middle, high = np.percentile(percent, [25, 50, 75])
        print(f"| {mode} | {middle:+.1f} % | {low:+.1f} to {high:+.1f} | {believed:.1f} % |", flush=True)


if __name__ == "__main__":
    main()

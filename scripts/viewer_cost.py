"""What the viewer costs a mapper: processor time with it against without it, in turns within one process.

A small map of the demo room is refined for blocks of steps. In every other block the viewer looks on, with a real
browser in each of its modes and without one; what its threads take is counted, what the browser takes is not. The
medians of neighbouring blocks' ratios are printed, beside what the viewer believes that it costs.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from contextlib import nullcontext

import numpy as np
from browser import choose_mode, missing, open_page
from ending import documented_ending

from fields.runtime.backend import initialise
from modp_ti.config.settings import ViewSettings
from modp_ti.engine.live_viewer import LiveViewer
from modp_ti.engine.mapper import Mapper
from modp_ti.files.errors import InputError
from modp_ti.inputs.synthetic import SyntheticTracker
from modp_ti.outputs.viewer.modes import MODES
from pipelines.settings import MappingSettings, RefineSettings

CLOSED = "no browser"
# Seconds between the last step of a block and the clock's reading, for what the viewer still has to send.
SETTLE = 0.3


class Turns:
    """Observes a refinement: lets the viewer look on in every other block of steps, and times the blocks.

    clock: what the viewer is to take for time: the process's, as far as blocks with it go.
    """

    def __init__(self, block: int) -> None:
        self.block = block
        self.viewer: LiveViewer | None = None
        self.seconds: dict[bool, list[float]] = {False: [], True: []}
        self._with = False
        self._before = 0.0  # of all blocks with the viewer that are over
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
        """Percent that each block with the viewer took beyond the mean of the blocks around it."""
        without, seen = self.seconds[False], self.seconds[True]
        return [100 * (s / (0.5 * (a + b)) - 1) for s, a, b in zip(seen, without, without[1:], strict=False)]


def measure(mapper: Mapper, mode: str, block: int, pairs: int) -> tuple[list[float], float]:
    """Percent of each block with the viewer in this mode, and what the viewer believes."""
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
    """Steps that change little: the map stays as it is, and all blocks have the same work."""
    settings = RefineSettings(views=1, min_contribution=0.0, position_decay=1.0, scale_decay=1.0)
    mapper.refine(steps, settings, progress)


@documented_ending()
def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=12, help="of the demo room that are mapped (default 12)")
    parser.add_argument("--block", type=int, default=60, help="steps of a block (default 60)")
    parser.add_argument("--pairs", type=int, default=8, help="blocks with the viewer, in each mode (default 8)")
    parser.add_argument("--mode", action="append", choices=(CLOSED, *MODES), help="only this one; repeatable")
    arguments = parser.parse_args()
    modes = arguments.mode or [CLOSED, *MODES]
    if modes != [CLOSED] and missing():
        raise InputError(missing())
    initialise("cpu", 1)
    tracker = SyntheticTracker(select=slice(arguments.frames))
    mapper = Mapper(tracker.camera.width, tracker.camera.height, MappingSettings())
    for frame in tracker:
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

"""Surveys the kernels of an engine on an architecture: registers, memory, occupancy and instructions."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

from gpu_kernels.estimate import BATCHES
from gpu_kernels.machine_code import LoopCounts, instructions_of, loop_counts
from gpu_kernels.occupancy import Architecture, limit, occupancy
from gpu_kernels.recording import record
from gpu_kernels.toolkit import Assembled, assemble, disassemble
from modp_ti.files.errors import InputError

# The compositing kernels: those that must not spill, and of which the first two are in every step.
COMPOSITING = {
    "DeviceCompositing._forward, loop 2": "forward",
    "DeviceCompositing._backward": "backward",
    "DeviceCompositing._backward_with_depth": "backward with depth",
}


@dataclass(frozen=True)
class Kernel:
    """A parallel task of a kernel on one architecture.

    Attributes:
        name: Class and function, with the loop's number if the kernel has several.
        threads: Threads of a block.
        shared: Shared memory of a block [bytes].
        registers: Registers of a thread.
        spilled: Spilled bytes of a thread, stored and loaded.
        stack: Local memory of a thread [bytes].
        occupancy: Share of the multiprocessor's warps that the kernel can fill.
        limit: What limits the occupancy.
        in_step: Number of launches in a step on one view.
    """

    name: str
    threads: int
    shared: int
    registers: int
    spilled: int
    stack: int
    occupancy: float
    limit: str
    in_step: int


@dataclass(frozen=True)
class Survey:
    """What the assembler makes of an engine's kernels on one architecture.

    Attributes:
        engine: Package of the engine.
        architecture: The architecture.
        target: PTX version and target that the engine emitted.
        entries: Number of entries assembled, serial tasks and the engine's own kernels included.
        kernels: Parallel tasks of our kernels.
        launches: Launches of a step on one view, serial tasks included.
        loops: Instructions of the compositing kernels of a step, by "forward" and "backward".
        failures: Modules that do not assemble and compositing kernels that spill, a line each.
    """

    engine: str
    architecture: Architecture
    target: str
    entries: int
    kernels: list[Kernel]
    launches: int
    loops: dict[str, LoopCounts]
    failures: list[str]


def survey(engine: str, architecture: Architecture) -> Survey:
    """Compile the kernels with an engine for an architecture, and assemble them.

    Raises:
        InputError: If the engine does not start, or a tool is missing.
    """
    with tempfile.TemporaryDirectory() as folder:
        recording = record(engine, architecture.capability, Path(folder))
        assembled: dict[str, Assembled] = {}
        failures: list[str] = []
        loops: dict[str, LoopCounts] = {}
        for module in recording.modules:
            cubin = module.with_suffix(".cubin")
            try:
                entries = assemble(module, architecture.capability, cubin)
            except InputError as error:
                failures.append(f"{engine}: {error}")
                continue
            assembled |= entries
            for entry in entries:
                stage = COMPOSITING.get(recording.name(entry) or "")
                if stage in BATCHES:
                    loops[stage] = loop_counts(instructions_of(disassemble(cubin), entry))
        kernels = []
        for launch in recording.launches:
            name, found = recording.name(launch.entry), assembled.get(launch.entry)
            if name is None or found is None:
                continue
            needs = (launch.threads, found.registers, found.shared + launch.shared)
            kernels.append(
                Kernel(
                    name,
                    launch.threads,
                    found.shared + launch.shared,
                    found.registers,
                    found.spilled,
                    found.stack,
                    occupancy(architecture, *needs),
                    limit(architecture, *needs),
                    recording.step[launch],
                )
            )
        failures += [
            f"{engine}: {kernel.name} spills {kernel.spilled} bytes on {architecture}"
            for kernel in kernels
            if kernel.spilled and kernel.name in COMPOSITING
        ]
        kernels.sort(key=lambda kernel: (kernel.name not in COMPOSITING, not kernel.in_step, kernel.name))
        return Survey(
            engine,
            architecture,
            recording.target(),
            len(assembled),
            kernels,
            sum(recording.step.values()),
            loops,
            failures,
        )

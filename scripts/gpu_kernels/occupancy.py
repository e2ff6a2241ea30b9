"""Occupancy: how many warps of a kernel a multiprocessor holds at once, of the most that it can hold."""

from __future__ import annotations

from dataclasses import dataclass

WARP = 32
REGISTERS = 65_536  # of a multiprocessor
SCHEDULERS = 4  # parts of a multiprocessor, each with a quarter of the registers
REGISTER_UNIT = 256  # registers are handed out to warps in multiples of this


@dataclass(frozen=True)
class Architecture:
    """Limits of a multiprocessor (CUDA C++ Programming Guide, "Compute Capabilities"; `cuda_occupancy.h`).

    Attributes:
        capability: Compute capability, for example 90.
        warps: Most resident warps.
        blocks: Most resident blocks.
        shared: Shared memory [bytes].
        shared_unit: Shared memory is handed out to blocks in multiples of this [bytes].
        reserved: Shared memory of each block that the system takes [bytes].
    """

    capability: int
    warps: int
    blocks: int
    shared: int
    shared_unit: int = 128
    reserved: int = 1024

    def __str__(self) -> str:
        return f"sm_{self.capability}"


ARCHITECTURES = {
    found.capability: found
    for found in (
        Architecture(75, 32, 16, 64 << 10, shared_unit=256, reserved=0),
        Architecture(86, 48, 16, 100 << 10),
        Architecture(89, 48, 24, 100 << 10),
        Architecture(90, 64, 32, 228 << 10),
        Architecture(100, 64, 32, 228 << 10),
        Architecture(120, 48, 24, 100 << 10),
    )
}


def _limits(architecture: Architecture, threads: int, registers: int, shared: int) -> dict[str, int]:
    """Most resident blocks by each resource."""
    warps = -(-threads // WARP)
    each = _round_up(max(registers, 1) * WARP, REGISTER_UNIT)
    by_registers = REGISTERS // SCHEDULERS // each * SCHEDULERS // warps
    taken = _round_up(shared + architecture.reserved, architecture.shared_unit)
    return {
        "registers": by_registers,
        "shared memory": architecture.shared // taken if taken else architecture.blocks,
        "warps": architecture.warps // warps,
        "blocks": architecture.blocks,
    }


def blocks_per_multiprocessor(architecture: Architecture, threads: int, registers: int, shared: int) -> int:
    """Most resident blocks of a kernel on a multiprocessor.

    Args:
        architecture: The multiprocessor.
        threads: Threads of a block.
        registers: Registers of a thread.
        shared: Shared memory of a block, static and dynamic [bytes].
    """
    return min(_limits(architecture, threads, registers, shared).values())


def occupancy(architecture: Architecture, threads: int, registers: int, shared: int) -> float:
    """Share of the multiprocessor's warps that a kernel can fill; arguments as in `blocks_per_multiprocessor`."""
    blocks = blocks_per_multiprocessor(architecture, threads, registers, shared)
    return blocks * -(-threads // WARP) / architecture.warps


def limit(architecture: Architecture, threads: int, registers: int, shared: int) -> str:
    """Resource that limits the occupancy; arguments as in `blocks_per_multiprocessor`."""
    limits = _limits(architecture, threads, registers, shared)
    return min(limits, key=lambda name: limits[name])


def _round_up(number: int, unit: int) -> int:
    return -(-number // unit) * unit

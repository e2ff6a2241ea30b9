"""Counts instructions in the inner loops of the compositing kernels, in disassembled machine code."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from modp_ti.files.errors import InputError

LABEL = re.compile(r"^\s*(\.L_\w+):")
INSTRUCTION = re.compile(r"^\s*/\*[0-9a-f]{4,}\*/\s+(@!?U?P\d\s+)?([A-Z0-9_.]+)(.*?);?\s*$")
TARGET = re.compile(r"`\((\.L_\w+)\)")


@dataclass(frozen=True)
class Instruction:
    """An instruction of a kernel.

    Attributes:
        opcode: Name with its suffixes.
        conditional: Whether it has a predicate.
        target: Index of the instruction that it may jump to; None for no jump.
    """

    opcode: str
    conditional: bool
    target: int | None

    @property
    def ends(self) -> bool:
        """Whether the next instruction does not follow."""
        return not self.conditional and self.opcode.partition(".")[0] in ("BRA", "EXIT")


@dataclass(frozen=True, order=True)
class Counts:
    """Instructions that a warp issues.

    Attributes:
        issued: All of them.
        shared: Accesses to shared memory among them. The four schedulers of a multiprocessor share one unit for these.
        special: Exponentials and reciprocals among them, which take a scheduler's unit eight cycles each.
    """

    issued: float = 0.0
    shared: float = 0.0
    special: float = 0.0

    def __add__(self, other: Counts) -> Counts:
        return Counts(self.issued + other.issued, self.shared + other.shared, self.special + other.special)

    def __mul__(self, times: float) -> Counts:
        return Counts(self.issued * times, self.shared * times, self.special * times)

    @property
    def cycles(self) -> float:
        """Least cycles on a scheduler: one an instruction, unless one of the units is the bottleneck."""
        return max(self.issued, 4.0 * self.shared, 8.0 * self.special)


@dataclass(frozen=True)
class LoopCounts:
    """What a warp issues in a compositing kernel.

    Attributes:
        hit: A Gaussian that reaches pixels of the warp, the longest way through the loop over a tile's Gaussians.
        missed: A Gaussian of whose rows none is the warp's.
        row: One row of a column's sums; zero in the forward pass.
        batch: A batch of Gaussians, without the loops over them.
        tile: A tile, without its batches.
    """

    hit: Counts
    missed: Counts
    row: Counts
    batch: Counts
    tile: Counts


def instructions_of(text: str, entry: str) -> list[Instruction]:
    """Parse the instructions of an entry from the output of `nvdisasm -c`.

    Raises:
        InputError: If the entry is not there.
    """
    places: dict[str, int] = {}
    found: list[tuple[str, bool, str | None]] = []
    inside = False
    for line in text.splitlines():
        if line.startswith("//-"):  # the header of a section
            inside = f" .text.{entry} " in line
        elif inside and (match := LABEL.match(line)):
            places[match[1]] = len(found)
        elif inside and (match := INSTRUCTION.match(line)):
            target = TARGET.search(match[3]) if match[2].partition(".")[0] == "BRA" else None
            # A jump may have its condition as an operand: `BRA P2, ...`.
            conditional = match[1] is not None or (target is not None and re.match(r"\s*!?U?P\d", match[3]) is not None)
            found.append((match[2], conditional, target[1] if target else None))
    if not found:
        raise InputError(f"nvdisasm shows no code of {entry}")
    return [Instruction(name, condition, places.get(to) if to else None) for name, condition, to in found]


def loop_counts(code: list[Instruction]) -> LoopCounts:
    """Count what a warp issues in a compositing kernel.

    The loop over a tile's Gaussians is the innermost one with an exponential. In the backward pass, the innermost loop
    with the most loads from shared memory beside it sums over rows; the assembler may have unrolled it.

    Args:
        code: Instructions of the kernel.

    Raises:
        InputError: If the code has no such loop.
    """
    loops = sorted(_loops(code), key=len)
    pairs = next((loop for loop in loops if _has(code, loop, "MUFU.EX2")), None)
    batches = next((loop for loop in loops if pairs and loop[0] < pairs[0] and loop[-1] > pairs[-1]), None)
    if pairs is None or batches is None:
        raise InputError("the machine code has no loop over Gaussians; scripts/gpu_kernels/machine_code.py expects one")
    ways = _ways(code, pairs)
    inner = [loop for loop in loops if set(loop) < set(batches) and loop != pairs and not _has(code, loop, "MUFU")]
    rows = max(inner, key=lambda loop: _count(code, loop).shared, default=range(0))
    # A row converts its number once, so that conversions tell how often the loop was unrolled.
    unrolled = sum(code[i].opcode.startswith("I2F") for i in rows)
    outside = set(batches).difference(pairs, *inner)
    return LoopCounts(
        hit=max(ways),
        missed=min(way for way in ways if way.shared),
        row=_count(code, rows) * (1.0 / max(unrolled, 1)),
        batch=_count(code, outside),
        tile=_count(code, set(range(len(code))).difference(batches)),
    )


def _loops(code: list[Instruction]) -> set[range]:
    """Indices of the instructions of every loop."""
    return {
        range(instruction.target, i + 1)
        for i, instruction in enumerate(code)
        if instruction.target is not None and instruction.target < i
    }


def _has(code: list[Instruction], loop: range, opcode: str) -> bool:
    return any(code[i].opcode.startswith(opcode) for i in loop)


def _count(code: list[Instruction], places: Iterable[int]) -> Counts:
    total = Counts()
    for i in places:
        name = code[i].opcode
        if name != "NOP" and code[i].target != i:  # neither what fills the end up nor the trap there
            total += Counts(1, name.startswith(("LDS", "STS")), name.startswith("MUFU"))
    return total


def _ways(code: list[Instruction], loop: range) -> set[Counts]:
    """Counts of all ways through one turn of a loop."""
    first, last = loop[0], loop[-1]
    ways: dict[int, set[Counts]] = {first: {Counts()}}
    done: set[Counts] = set()
    for i in range(first, last + 1):
        here = {way + _count(code, [i]) for way in ways.pop(i, set())}
        target = code[i].target
        if i == last:
            done |= here
            continue
        if target is not None and i < target <= last:
            ways.setdefault(target, set()).update(here)
        if not code[i].ends:
            ways.setdefault(i + 1, set()).update(here)
    return done

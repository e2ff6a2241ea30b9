"""Formats the survey of the kernels as Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from gpu_kernels.estimate import CARDS, Work, backward_counts, forward_counts, memory_milliseconds, milliseconds
from gpu_kernels.survey import COMPOSITING, Kernel, Survey

ESTIMATE = """\
Estimated time of a step on one view, on cards that nobody has measured. Compositing: the instructions that all warps
issue, counted from the machine code and from the lists that the CPU bins in tiles of 16x16 pixels, divided by
multiprocessors x 4 schedulers x boost clock, or the cycles of the units for shared memory and exponentials if these
take longer. This is the least time, with every scheduler busy in every cycle; waiting and uneven tiles add to it.
Pairs behind opaque pixels are counted, which takes from it. Memory: the bytes of the whole step, each moved once by
each kernel that uses it, divided by the bandwidth. PyTorch's sorts are in the bytes, not in the launches."""


def report(surveys: Sequence[Survey], works: Sequence[Work], versions: str) -> str:
    """Return the tables.

    Args:
        surveys: Surveys by engine, and of an engine by architecture.
        works: Work of a step, for the estimates.
        versions: What to say of the tools.
    """
    parts = ["# The GPU's kernels, assembled without a GPU", versions]
    for engine in dict.fromkeys(found.engine for found in surveys):
        of = [found for found in surveys if found.engine == engine]
        parts += [f"## {engine.capitalize()}", _about(of), _kernels(of), _compositing(of)]
    parts += ["## Estimates", ESTIMATE, *(table for work in works if (table := _estimates(surveys, work)))]
    return "\n\n".join(parts)


def _about(surveys: Sequence[Survey]) -> str:
    targets = ", ".join(f"{found.target} on {found.architecture}" for found in surveys)
    entries = ", ".join(str(found.entries) for found in surveys)
    return (
        f"The engine emits {targets}. Entries assembled: {entries}. Launches of a step on one view: "
        f"{surveys[0].launches}. In the columns: registers of a thread, and the occupancy that registers, shared "
        "memory and blocks allow; bytes of a thread that are spilled, and of its local memory, where there are any. "
        "Compositing comes first, then the kernels of a step, with the number of their launches."
    )


def _kernels(surveys: Sequence[Survey]) -> str:
    rows = [["kernel", "in a step", "threads", "shared [bytes]", *(str(found.architecture) for found in surveys)]]
    first = {kernel.name: kernel for found in reversed(surveys) for kernel in found.kernels}
    by_name = [{kernel.name: kernel for kernel in found.kernels} for found in surveys]
    for name in dict.fromkeys(kernel.name for found in surveys for kernel in found.kernels):
        kernel = first[name]
        cells = [_cell(kernels[name]) if name in kernels else "-" for kernels in by_name]
        rows.append([f"`{name}`", str(kernel.in_step), str(kernel.threads), f"{kernel.shared:,}", *cells])
    return _table(rows)


def _cell(kernel: Kernel) -> str:
    text = f"{kernel.registers}, {100 * kernel.occupancy:.0f} %"
    if kernel.spilled:
        text += f", {kernel.spilled} B spilled"
    return text + (f", {kernel.stack} B local" if kernel.stack else "")


def _compositing(surveys: Sequence[Survey]) -> str:
    """What limits compositing, and its instructions per pair."""
    rows = [
        ["architecture", "kernel", "occupancy", "limited by", "reached", "missed", "row", "batch", "shared, reached"]
    ]
    for found in surveys:
        for kernel in found.kernels:
            loop = found.loops.get(COMPOSITING.get(kernel.name, ""))
            if loop is not None:
                figures = (loop.hit.issued, loop.missed.issued, loop.row.issued, loop.batch.issued, loop.hit.shared)
                said = [str(found.architecture), COMPOSITING[kernel.name], f"{100 * kernel.occupancy:.0f} %"]
                rows.append([*said, kernel.limit, *(f"{figure:.0f}" for figure in figures)])
    return (
        "Instructions of a warp in compositing: for a Gaussian that reaches its pixels, for one that misses its rows, "
        "for a row of the backward pass's sums, and for a batch (256 Gaussians in the forward pass, 16 in the backward "
        "pass); accesses to shared memory among the first.\n\n" + _table(rows)
    )


def _estimates(surveys: Sequence[Survey], work: Work) -> str:
    rows = [["card", "engine", "forward [ms]", "backward [ms]", "memory, whole step [ms]"]]
    for card in CARDS:
        for found in surveys:
            if found.architecture.capability == card.capability and len(found.loops) == 2:
                forward = milliseconds(card, forward_counts(work, found.loops["forward"]))
                backward = milliseconds(card, backward_counts(work, found.loops["backward"]))
                times = (forward, backward, memory_milliseconds(card, work))
                rows.append([card.name, found.engine.capitalize(), *(f"{time:.3f}" for time in times)])
    if len(rows) == 1:
        return ""
    reached = work.hits / (8 * work.pairs)
    return (
        f"{work.size}: {work.pairs:,} pairs of tile and Gaussian, {100 * reached:.0f} % of whose warps are reached; "
        f"{work.pixel_pairs / 1e6:.2f} million pairs of pixel and Gaussian in the rows that are reached.\n\n"
        + _table(rows)
    )


def _table(rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]])

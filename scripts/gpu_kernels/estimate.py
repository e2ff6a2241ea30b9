"""Estimates the time of a step on a card that is not there, from instructions and bytes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from step import ADAM_BYTES, Size, add_gaussians, camera_of

from fields.buffers.device_pairs import TILE_HEIGHT, TILE_PIXELS, TILE_WIDTH, tile_count
from fields.buffers.tiles import TilePairs
from fields.map.gaussians import GaussianField
from fields.runtime.backend import initialise
from fields.runtime.engine import ti
from gpu_kernels.machine_code import Counts, LoopCounts
from gpu_kernels.occupancy import SCHEDULERS, WARP
from pipelines.render.cpu.binning import Binning
from pipelines.render.gpu.compositing_gradient import STEP
from pipelines.render.renderer import Renderer

# Gaussians of a batch in shared memory.
BATCHES = {"forward": TILE_PIXELS, "backward": STEP}
WARPS = TILE_PIXELS // WARP  # of a tile
WARP_ROWS = WARP // TILE_WIDTH
NEAR = 0.01

# Bytes that a step reads or writes in the device's memory, if each kernel moves each of its values once.
# Of a pixel: the image written (5 floats) and its reference (4); the loss (12 of images read, 12 of SSIM written and 9
# read, 2 of the mask); the gradient written and read (6); what else the backward pass reads (5).
PIXEL_BYTES = 4 * (5 + 4 + 12 + 21 + 2 + 6 + 5)
# Of a pair: key and index through four passes of a sort; slot, rows and origin written and read twice; ten values of
# its Gaussian read twice; ten sums written and read.
PAIR_BYTES = 4 * 2 * (2 + 8) + 3 * (4 + 4 + 8) + 2 * 40 + 2 * 40
# Of a Gaussian: depth and index through eight passes of a sort; its 14 values and the 12 projected ones, read or
# written by ten kernels; and Adam's.
GAUSSIAN_BYTES = 8 * 2 * (4 + 8) + 10 * 4 * (14 + 12) + ADAM_BYTES


@dataclass(frozen=True)
class Card:
    """A graphics card, with its published figures.

    Attributes:
        name: Name.
        capability: Compute capability.
        multiprocessors: Number of multiprocessors.
        clock: Boost clock [Hz].
        bandwidth: Bandwidth of the memory [bytes/s].
    """

    name: str
    capability: int
    multiprocessors: int
    clock: float
    bandwidth: float


CARDS = (
    Card("RTX 3060", 86, 28, 1.78e9, 360e9),
    Card("RTX 4090", 89, 128, 2.52e9, 1008e9),
    Card("H100 SXM", 90, 132, 1.83e9, 3350e9),
)


@dataclass(frozen=True)
class Work:
    """Work of the compositing kernels in one step, measured on the CPU in tiles of the GPU's shape.

    Attributes:
        size: Size of the scene.
        tiles: Number of tiles.
        pairs: Number of (tile, Gaussian) pairs. Some are not composited, because their tile is opaque before.
        hits: Number of (warp, Gaussian) pairs with rows that the Gaussian reaches.
        rows: Number of rows that the warps sum over in the backward pass; the longer of two Gaussians counts.
        batches: Number of batches of the forward and of the backward pass.
        pixel_pairs: Number of (pixel, Gaussian) pairs in the rows that Gaussians reach.
    """

    size: Size
    tiles: int
    pairs: int
    hits: int
    rows: int
    batches: dict[str, int]
    pixel_pairs: int


@ti.data_oriented
class _SquareBinning(Binning):
    """The CPU's binning in tiles of the GPU's shape."""

    tile_width, tile_height = TILE_WIDTH, TILE_HEIGHT


def measure_work(size: Size) -> Work:
    """Project and bin the benchmark's scene on the CPU, and count the work of the GPU's kernels."""
    initialise("cpu")
    gaussians = GaussianField()
    add_gaussians(gaussians, size)
    renderer = Renderer(gaussians, size.width, size.height)
    renderer.forward(camera_of(size.width, size.height), np.eye(4), NEAR)
    pairs = renderer.pairs
    assert isinstance(pairs, TilePairs)  # the CPU's
    _SquareBinning(renderer.view, renderer.projected, pairs).forward()
    per_tile = pairs.tile_count.to_numpy()[: tile_count(size.width, size.height)].astype(np.int32)
    return count_work(size, per_tile, pairs.rows_to_numpy())


def count_work(size: Size, per_tile: NDArray[np.int32], packed: NDArray[np.int32]) -> Work:
    """Count the work of the kernels.

    Args:
        size: Size of the scene.
        per_tile: Number of pairs of each tile.
        packed: Rows of each pair, tile by tile, as first | (last + 1) << 16.
    """
    top, end = packed & 0xFFFF, packed >> 16
    height = np.maximum(end - top, 0)
    hits = np.where(height > 0, (end - 1) // WARP_ROWS - top // WARP_ROWS + 1, 0)
    # In the backward pass, a warp sums over the rows of two neighbours of a tile's list at a time.
    ends = np.cumsum(per_tile)
    place = np.arange(len(packed)) - np.repeat(ends - per_tile, per_tile)
    last = place + 1 == np.repeat(per_tile, per_tile)
    neighbour = np.where(last, 0, np.append(height[1:], 0))
    return Work(
        size,
        tiles=len(per_tile),
        pairs=len(packed),
        hits=int(hits.sum()),
        rows=int(np.maximum(height, neighbour)[place % 2 == 0].sum()),
        batches={name: int((-(-per_tile // batch)).sum()) for name, batch in BATCHES.items()},
        pixel_pairs=int(height.sum()) * TILE_WIDTH,
    )


def forward_counts(work: Work, loop: LoopCounts) -> Counts:
    """What all warps of a step issue in the forward pass of compositing."""
    return _loop_counts(work, loop, work.batches["forward"])


def backward_counts(work: Work, loop: LoopCounts) -> Counts:
    """What all warps of a step issue in the backward pass of compositing."""
    return _loop_counts(work, loop, work.batches["backward"]) + loop.row * work.rows


def _loop_counts(work: Work, loop: LoopCounts, batches: int) -> Counts:
    missed = WARPS * work.pairs - work.hits
    return (
        loop.hit * work.hits + loop.missed * missed + loop.batch * (WARPS * batches) + loop.tile * (WARPS * work.tiles)
    )


def milliseconds(card: Card, counts: Counts) -> float:
    """Least time for these instructions, with every scheduler busy in every cycle [ms]."""
    return 1e3 * counts.cycles / (card.multiprocessors * SCHEDULERS * card.clock)


def memory_milliseconds(card: Card, work: Work) -> float:
    """Least time for the bytes of a whole step, none of them from a cache [ms]."""
    size = work.size
    moved = PIXEL_BYTES * size.width * size.height + PAIR_BYTES * work.pairs + GAUSSIAN_BYTES * size.gaussians
    return 1e3 * moved / card.bandwidth

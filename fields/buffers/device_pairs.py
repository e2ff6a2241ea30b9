"""`DevicePairs`: the GPU's lists of which Gaussians reach which tile, in tensors that grow between renders."""

import taichi as ti
import torch

from fields.runtime.backend import torch_device

__all__ = ["NO_TILE", "TILE_HEIGHT", "TILE_PIXELS", "TILE_WIDTH", "DevicePairs", "tile_count"]

# A thread a pixel; square, for few pairs. The CPU's tiles are narrow for the sake of its vectors.
TILE_WIDTH = TILE_HEIGHT = 16
TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
# Key of the unused entries: behind all tiles. Keys have 16 bits where tiles allow, which halves the passes of the sort.
NO_TILE = {torch.int16: 2**15 - 1, torch.int32: 2**31 - 1}
# Room grows by whole steps, so that it seldom does.
STEP = 1 << 16


def tile_count(width: int, height: int) -> int:
    """Tiles of an image."""
    return -(-width // TILE_WIDTH) * -(-height // TILE_HEIGHT)


@ti.data_oriented
class DevicePairs:
    """Pairs (tile, Gaussian) in two orders: as emitted, slot by slot (nearest first), and sorted by tile.

    Per tile: `first` and `tile_count` of its sorted pairs, `reached`: how many of them were composited before it was
    opaque. Per emitted pair: `key` (its tile), `emitted_slot` and `gradient` (ten sums over the tile's pixels, those
    of a slot one after another from `projected.first_pair`). Per sorted pair: `slot` of the projected Gaussian, `rows`
    as in `TilePairs`, and `origin`: its place in the emitted order.

    room: how many pairs a view may have at present, of the `capacity` of the tensors; what is beyond the used ones is
    sorted with them. total: pairs of the last view, on the device; those beyond `room` (the farthest) are left out.
    """

    def __init__(self, builder: ti.FieldsBuilder, max_width: int, max_height: int, max_pairs: int = 1 << 26) -> None:
        self.max_tiles = max_tiles = tile_count(max_width, max_height)
        self.max_pairs = max_pairs
        self.capacity = 0
        self.room = 0
        self.device = torch_device()
        self.first = ti.field(ti.i32)
        self.tile_count = ti.field(ti.i32)
        self.reached = ti.field(ti.i32)
        self.total = ti.field(ti.i32)
        builder.dense(ti.i, max_tiles).place(self.first, self.tile_count, self.reached)
        builder.place(self.total)
        self.last_placed = self.total

    def make_room(self, pairs: int) -> None:
        """Have room for `pairs` pairs, and less than a step more, up to `max_pairs`.

        What the tensors held is lost where they grow.
        """
        self.room = n = min(-(-pairs // STEP) * STEP, self.max_pairs)
        if n <= self.capacity:
            return
        self.capacity = n
        kind = torch.int16 if self.max_tiles < NO_TILE[torch.int16] else torch.int32
        self.key = torch.empty(n, dtype=kind, device=self.device)
        self.emitted_slot, self.slot, self.rows = (
            torch.empty(n, dtype=torch.int32, device=self.device) for _ in range(3)
        )
        self.gradient = torch.empty(10 * n, dtype=torch.float32, device=self.device)
        # Until the first sort.
        self.origin = torch.empty(n, dtype=torch.int64, device=self.device)

    @property
    def count(self) -> int:
        """Pairs of the last view that there was room for. Waits for the device."""
        return min(self.total[None], self.room)

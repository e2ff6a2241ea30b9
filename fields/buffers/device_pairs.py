"""`DevicePairs`: the GPU's (tile, Gaussian) pairs, in tensors that grow between renders."""

import torch

from fields.runtime.backend import torch_device
from fields.runtime.engine import ti

# One thread per pixel. Square tiles keep the number of pairs low; the CPU's tiles are narrow for its vector units.
TILE_WIDTH = TILE_HEIGHT = 16
TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
# Key of unused entries, which sorts after all tiles. Keys have 16 bits if the number of tiles allows it, which halves
# the passes of the sort.
NO_TILE = {torch.int16: 2**15 - 1, torch.int32: 2**31 - 1}
# The tensors grow in multiples of this, so that they grow rarely.
STEP = 1 << 16


def tile_count(width: int, height: int) -> int:
    """Number of tiles of an image."""
    return -(-width // TILE_WIDTH) * -(-height // TILE_HEIGHT)


@ti.data_oriented
class DevicePairs:
    """Pairs (tile, Gaussian) in two orders: as emitted, slot by slot (nearest first), and sorted by tile.

    Attributes:
        first: Per tile, the index of its first sorted pair.
        tile_count: Per tile, the number of its pairs.
        reached: Per tile, the number of pairs that were composited before the tile was opaque.
        key: Per emitted pair, its tile.
        emitted_slot: Per emitted pair, the slot of the projected Gaussian.
        gradient: Per emitted pair, ten sums over the tile's pixels. Those of a slot are contiguous from
            `projected.first_pair`.
        tile: Per sorted pair, its tile.
        slot: Per sorted pair, the slot of the projected Gaussian.
        rows: Per sorted pair, the rows that its ellipse reaches, as in `TilePairs`.
        origin: Per sorted pair, its index in the emitted order.
        capacity: Size of the tensors.
        room: Number of pairs that a view may currently have, at most `capacity`. Unused entries up to it are sorted as
            well.
        total: Number of pairs of the last view, on the device; `room` + 1 if there are more. Pairs beyond `room` (the
            farthest ones) are dropped.
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
        """Set `room` to `pairs`, rounded up to a multiple of `STEP` and limited to `max_pairs`.

        If the tensors have to grow, their contents are lost.
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
        # Placeholders, which the first sort replaces.
        self.tile, self.origin = self.key, torch.empty(n, dtype=torch.int64, device=self.device)

    @property
    def count(self) -> int:
        """Number of pairs of the last view, at most `room`. Waits for the device."""
        return min(self.total[None], self.room)  # pyright: ignore[reportReturnType]  # an int in a scalar field

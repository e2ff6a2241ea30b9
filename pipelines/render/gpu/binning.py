"""Binning on a GPU: pairs are emitted slot by slot, nearest first, and then sorted stably by tile."""
# pyright: reportArgumentType=false, reportIndexIssue=false, reportInvalidTypeForm=false

from collections import deque

import torch

from fields.buffers.device_pairs import NO_TILE, TILE_HEIGHT, TILE_WIDTH, DevicePairs
from fields.buffers.view import ProjectedGaussians, ViewField
from fields.runtime.backend import torch_device
from fields.runtime.compiled_kernel import AsyncReadback, CompiledKernel
from fields.runtime.engine import ti
from pipelines.render.formulas import EllipseFormulas

# The room for pairs is MARGIN times the largest total of the last MEMORY views. A view with more pairs loses its
# farthest ones.
MARGIN, MEMORY = 1.5, 64
# Number of views after which a total is read. The copy has finished by then, and the fixed delay is deterministic.
PATIENCE = 2


@ti.data_oriented
class DeviceBinning(EllipseFormulas):
    """Fills `pairs` from `projected` for the view in `view`; see `Binning`.

    The projection counts the tiles of each slot, and compositing arranges the sorted pairs, which saves launches.
    """

    tile_width, tile_height = TILE_WIDTH, TILE_HEIGHT

    def __init__(self, view: ViewField, projected: ProjectedGaussians, pairs: DevicePairs) -> None:
        super().__init__(view, projected)
        self.pairs = pairs
        self._emit_pairs = CompiledKernel(self._emit)
        self._totals: deque[AsyncReadback] = deque()
        self._known: deque[int] = deque(maxlen=MEMORY)
        self._counts = torch.empty(0, dtype=torch.int32, device=torch_device())
        self._slots = 0

    def tiles(self) -> tuple[int, int]:
        """Number of the view's columns and rows of tiles."""
        return -(-self.view.width // TILE_WIDTH), -(-self.view.height // TILE_HEIGHT)

    def make_counts(self, slots: int) -> torch.Tensor:
        """Return the array (slots,) for the number of tiles that each slot reaches."""
        self._slots = slots
        if len(self._counts) < slots:
            self._counts = torch.empty(1 << (slots - 1).bit_length(), dtype=torch.int32, device=torch_device())
        return self._counts[:slots]

    def forward(self, exact: bool = True) -> None:
        pairs = self.pairs
        ends = torch.cumsum(self._counts[: self._slots], 0)
        self._make_room(ends, exact)
        used = pairs.key[: pairs.room]
        self._emit_pairs(pairs.room, NO_TILE[pairs.key.dtype], *self.tiles(), ends, used, pairs.emitted_slot)
        pairs.tile, pairs.origin = torch.sort(used, stable=True)

    def _make_room(self, ends: torch.Tensor, exact: bool) -> None:
        self._totals.append(AsyncReadback(ends[-1:]))
        # There is no earlier total for the first view.
        exact = exact or not self._known
        while self._totals and (exact or len(self._totals) > PATIENCE):
            self._known.append(int(self._totals.popleft().numpy()[0]))
        if exact and self._known[-1] > self.pairs.max_pairs:
            raise ValueError(
                f"{self._known[-1]} tile pairs exceed the room for {self.pairs.max_pairs}; the map is degenerate"
            )
        self.pairs.make_room(max(int(MARGIN * max(self._known)), 1))

    @ti.func
    def count_tiles(self, s, tiles_x, tiles_y):
        """Number of tiles that slot s reaches."""
        n = 0
        e = self._ellipse(s)
        if e[4] > 0.0:
            rows = self._tile_rows(s, e, tiles_y)
            for tile_y in range(rows[0], rows[1]):
                columns = self._tile_columns(s, e, tile_y, tiles_x)
                n += ti.max(columns[1] - columns[0], 0)
        return n

    @ti.kernel
    def _emit(
        self,
        room: ti.i32,
        no_tile: ti.i32,
        tiles_x: ti.i32,
        tiles_y: ti.i32,
        ends: ti.types.ndarray(dtype=ti.i64, ndim=1),
        key: ti.types.ndarray(ndim=1),
        slot: ti.types.ndarray(dtype=ti.i32, ndim=1),
    ):
        n, tiles = ends.shape[0], tiles_x * tiles_y
        for i in range(ti.max(n, room, tiles)):
            # Clamped to room + 1, so that it fits in 32 bits.
            total = ti.cast(ti.min(ends[n - 1], ti.cast(room, ti.i64) + 1), ti.i32)
            if i == 0:
                self.pairs.total[None] = total
            if i < tiles:
                self.pairs.first[i] = 0
                self.pairs.tile_count[i] = 0
            if total <= i and i < room:
                key[i] = no_tile
            if i < self.projected.seen[None]:
                self._emit_slot(i, room, tiles_x, tiles_y, ends, key, slot)

    @ti.func
    def _emit_slot(self, s, room, tiles_x, tiles_y, ends: ti.template(), key: ti.template(), slot: ti.template()):
        place = ti.i64(0)
        if s > 0:
            place = ends[s - 1]
        pair = ti.cast(ti.min(place, ti.cast(room, ti.i64)), ti.i32)
        self.projected.first_pair[s] = pair
        e = self._ellipse(s)
        if e[4] > 0.0 and pair < room:
            rows = self._tile_rows(s, e, tiles_y)
            for tile_y in range(rows[0], rows[1]):
                columns = self._tile_columns(s, e, tile_y, tiles_x)
                for tile_x in range(columns[0], ti.min(columns[1], columns[0] + room - pair)):
                    key[pair] = tile_y * tiles_x + tile_x
                    slot[pair] = s
                    pair += 1

    @ti.func
    def arrange(
        self, k, tiles, tiles_x, key: ti.template(), origin: ti.template(), emitted: ti.template(),
        slot: ti.template(), rows: ti.template(),
    ):  # fmt: skip
        """Find the slot and rows of the sorted pair k, and where its tile begins and ends."""
        tile, n = ti.cast(key[k], ti.i32), key.shape[0]
        if tile < tiles:
            s = emitted[origin[k]]
            slot[k] = s
            # Computed here and not in `_emit`, since here each pair has its own thread.
            rows[k] = self._pixel_rows(s, self._ellipse(s), tile % tiles_x, tile // tiles_x)
            if k == 0 or ti.cast(key[ti.max(k - 1, 0)], ti.i32) != tile:
                self.pairs.first[tile] = k
                ti.atomic_add(self.pairs.tile_count[tile], -k)
            if k + 1 == n or ti.cast(key[ti.min(k + 1, n - 1)], ti.i32) != tile:
                ti.atomic_add(self.pairs.tile_count[tile], k + 1)

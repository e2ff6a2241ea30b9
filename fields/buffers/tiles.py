"""`TilePairs`: lists of the Gaussians that reach each tile, nearest first."""
# pyright: reportInvalidTypeForm=false

import numpy as np

from fields.runtime.backend import sparse
from fields.runtime.engine import ti

# Powers of two. A row of a tile is one vector of eight float32, the width that LLVM uses even where the processor has
# wider vectors. Pixels of a row outside the ellipse are wasted work. Rows outside it are skipped, so that tall tiles
# waste nothing and keep the number of pairs low.
TILE_WIDTH = 8
TILE_HEIGHT = 32
TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
# Number of pairs that a tile composites between two checks for opacity.
GROUP = 16
BLOCK = 4096


@ti.data_oriented
class TilePairs:
    """Pairs (tile, Gaussian), sorted by tile and within a tile by depth.

    Attributes:
        first: Per tile, the index of its first pair.
        tile_count: Per tile, the number of its pairs.
        reached: Per tile, the number of pairs that were composited before the tile was opaque.
        emitted_tile: Per unsorted pair, in depth order chunk by chunk, its tile.
        emitted_rows: Per unsorted pair, its rows.
        slot: Per sorted pair, the slot of the projected Gaussian.
        rows: Per sorted pair, the first row that its ellipse reaches in the tile and the row after the last, packed as
            first | last << 16.
        gradient: Per sorted pair, ten sums over the tile's pixels (see `compositing.py`).
        staged: Per tile, contiguous copies of the Gaussians of the `GROUP` pairs that are being composited.
        position: `position[e]`, for e from `first_pair` to `end_pair` of a slot, are the indices of its sorted pairs.
        count: Number of pairs.
    """

    def __init__(
        self, builder: ti.FieldsBuilder, max_tiles: int, chunks: int, max_pairs: int = 1 << 23, real=ti.f32
    ) -> None:
        self.max_tiles = max_tiles
        self.max_pairs = max_pairs
        # Largest number of pairs of one chunk. The chunk of the nearest Gaussians has the largest ellipses.
        self.segment = max_pairs // 4
        self.count = 0
        self.first = ti.field(ti.i32)
        self.tile_count = ti.field(ti.i32)
        self.reached = ti.field(ti.i32)
        self.histogram = ti.field(ti.i32)
        self.chunk_pairs = ti.field(ti.i32)
        self.emitted_tile = ti.field(ti.i32)
        self.emitted_rows = ti.field(ti.i32)
        self.slot = ti.field(ti.i32)
        self.rows = ti.field(ti.i32)
        self.position = ti.field(ti.i32)
        self.gradient = ti.Vector.field(10, real)
        self.staged = ti.Vector.field(10, real)
        builder.dense(ti.i, max_tiles).place(self.first, self.tile_count, self.reached)
        builder.dense(ti.ij, (chunks, max_tiles)).place(self.histogram)
        builder.dense(ti.i, max_tiles * GROUP).place(self.staged)
        builder.dense(ti.i, chunks + 1).place(self.chunk_pairs)
        blocks = sparse(builder, ti.i, (max_pairs // BLOCK,))
        blocks.dense(ti.i, BLOCK).place(self.slot, self.rows)
        blocks.dense(ti.i, BLOCK).place(self.position)
        blocks.dense(ti.i, BLOCK).place(self.gradient)
        segments = sparse(builder, ti.i, (chunks * self.segment // BLOCK,))
        segments.dense(ti.i, BLOCK).place(self.emitted_tile, self.emitted_rows)
        self.last_placed = self.emitted_rows

    def rows_to_numpy(self) -> np.ndarray:
        """Return `rows` (count,) int32 of all sorted pairs."""
        out = np.zeros(self.count, dtype=np.int32)
        if self.count:
            self._read_rows(out)
        return out

    @ti.kernel
    def _read_rows(self, out: ti.types.ndarray()):
        for i in range(out.shape[0]):
            out[i] = self.rows[i]

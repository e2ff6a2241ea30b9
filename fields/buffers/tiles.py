"""`TilePairs`: which Gaussians reach which tile of the image, nearest first."""

import numpy as np
import taichi as ti

__all__ = ["GROUP", "TILE_HEIGHT", "TILE_PIXELS", "TILE_WIDTH", "TilePairs"]

# Powers of two. A row of a tile is one vector of eight float32, as LLVM makes them even where there are wider ones:
# what an ellipse does not reach of a row is wasted work. A tall tile wastes none, and keeps the pairs few.
TILE_WIDTH = 8
TILE_HEIGHT = 32
TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
# Pairs that a tile composites between two looks at what is left to do.
GROUP = 16
BLOCK = 4096


@ti.data_oriented
class TilePairs:
    """Pairs (tile, Gaussian), sorted by tile and within a tile by depth.

    Per tile: `first` and `count` of its pairs, `reached`: how many of them were composited before it was opaque.
    Per pair, in the order of depth, chunk by chunk: `emitted_tile` and `emitted_rows`, before they are sorted.
    Per sorted pair: `slot` of the projected Gaussian, `rows`: first row and row behind the last that its ellipse
    reaches in the tile (first | last << 16), `gradient`: ten sums over the tile's pixels (see `compositing.py`).
    `staged`, GROUP of a tile: what compositing needs of the Gaussians of the pairs that it is at, close together.
    `position[e]` for e from slot s's `first_pair` to its `end_pair` are the places of its pairs.
    """

    def __init__(
        self, builder: ti.FieldsBuilder, max_tiles: int, chunks: int, max_pairs: int = 1 << 23, real=ti.f32
    ) -> None:
        self.max_tiles = max_tiles
        self.max_pairs = max_pairs
        # Pairs of one chunk at most: the nearest have the largest ellipses.
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
        blocks = builder.pointer(ti.i, max_pairs // BLOCK)
        blocks.dense(ti.i, BLOCK).place(self.slot, self.rows)
        blocks.dense(ti.i, BLOCK).place(self.position)
        blocks.dense(ti.i, BLOCK).place(self.gradient)
        segments = builder.pointer(ti.i, chunks * self.segment // BLOCK)
        segments.dense(ti.i, BLOCK).place(self.emitted_tile, self.emitted_rows)
        self.last_placed = self.emitted_rows

    def rows_to_numpy(self) -> np.ndarray:
        """`rows` of all pairs (count,) int32, in the order of the lists."""
        out = np.zeros(self.count, dtype=np.int32)
        if self.count:
            self._read_rows(out)
        return out

    @ti.kernel
    def _read_rows(self, out: ti.types.ndarray()):
        for i in range(out.shape[0]):
            out[i] = self.rows[i]

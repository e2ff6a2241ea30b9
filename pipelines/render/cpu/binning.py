"""Binning: lists of the (tile, Gaussian) pairs that overlap, sorted by tile and then by depth.

This is a counting sort over (tile, chunk of slots). It is linear in the number of pairs, stable because chunks and the
slots in them are processed in depth order, and independent of the number of threads.
"""
# pyright: reportArgumentType=false, reportIndexIssue=false, reportInvalidTypeForm=false

import numpy as np

from fields.buffers.tiles import TILE_HEIGHT, TILE_WIDTH, TilePairs
from fields.buffers.view import ProjectedGaussians, ViewField
from fields.runtime.compiled_kernel import HANDED_OUT, CompiledKernel, CompiledLoop
from fields.runtime.engine import ti
from pipelines.render.formulas import EllipseFormulas

CHUNKS = 16
# One of these chunks per scheduling chunk, see `fields.runtime.compiled_kernel`.
SPREAD = HANDED_OUT


@ti.data_oriented
class Binning(EllipseFormulas):
    """Fills `pairs` from `projected` for the view in `view`, in tiles of `tile_width` x `tile_height` pixels."""

    tile_width, tile_height = TILE_WIDTH, TILE_HEIGHT

    def __init__(self, view: ViewField, projected: ProjectedGaussians, pairs: TilePairs) -> None:
        super().__init__(view, projected)
        self.pairs = pairs
        self._total = np.zeros(1, dtype=np.int64)
        self._count, self._scan = CompiledKernel(self._count_chunks), CompiledKernel(self._scan_counts)
        self._scatter = CompiledLoop(self._scatter_chunks, 50)

    def forward(self, exact: bool = True) -> None:
        tiles_x = -(-self.view.width // self.tile_width)
        tiles_y = -(-self.view.height // self.tile_height)
        slots = self.projected.count
        self._count(slots, tiles_x, tiles_y)
        self._scan(tiles_x * tiles_y, self._total)
        total = int(self._total[0])
        if total > self.pairs.max_pairs:
            raise ValueError(f"{total} tile pairs exceed the room for {self.pairs.max_pairs}; the map is degenerate")
        self._scatter(slots, slots)
        self.pairs.count = total

    @ti.kernel
    def _count_chunks(self, slots: ti.i32, tiles_x: ti.i32, tiles_y: ti.i32):
        for i in range(CHUNKS * SPREAD):
            if i % SPREAD == 0:
                self._count_chunk(i // SPREAD, slots, tiles_x, tiles_y)

    @ti.func
    def _count_chunk(self, chunk, slots, tiles_x, tiles_y):
        for t in range(tiles_x * tiles_y):
            self.pairs.histogram[chunk, t] = 0
        n, segment = 0, ti.static(self.pairs.segment)
        for k in range(slots * chunk // CHUNKS, slots * (chunk + 1) // CHUNKS):
            s = self.projected.order[k]
            self.projected.first_pair[s] = n
            e = self._ellipse(s)
            if e[4] > 0.0:
                rows = self._tile_rows(s, e, tiles_y)
                for tile_y in range(rows[0], rows[1]):
                    columns = self._tile_columns(s, e, tile_y, tiles_x)
                    for tile_x in range(columns[0], columns[1]):
                        t = tile_y * tiles_x + tile_x
                        self.pairs.histogram[chunk, t] = self.pairs.histogram[chunk, t] + 1
                        if n < segment:
                            self.pairs.emitted_tile[chunk * segment + n] = t
                            self.pairs.emitted_rows[chunk * segment + n] = self._pixel_rows(s, e, tile_x, tile_y)
                        n += 1
            self.projected.end_pair[s] = n
        self.pairs.chunk_pairs[chunk] = n

    @ti.kernel
    def _scan_counts(self, tiles: ti.i32, total: ti.types.ndarray()):
        # A serial pass over tiles x chunks takes microseconds and needs no synchronisation.
        ti.loop_config(serialize=True)
        for _ in range(1):
            place = 0
            for t in range(tiles):
                self.pairs.first[t] = place
                for chunk in range(CHUNKS):
                    n = self.pairs.histogram[chunk, t]
                    self.pairs.histogram[chunk, t] = place
                    place += n
                self.pairs.tile_count[t] = place - self.pairs.first[t]
            total[0] = place
            pairs = 0
            for chunk in range(CHUNKS):
                n = self.pairs.chunk_pairs[chunk]
                if n > self.pairs.segment:
                    total[0] = self.pairs.max_pairs + 1
                self.pairs.chunk_pairs[chunk] = pairs
                pairs += n

    @ti.kernel
    def _scatter_chunks(self, alone: ti.template(), slots: ti.i32):
        ti.loop_config(serialize=alone)
        for i in range(CHUNKS * SPREAD):
            if i % SPREAD == 0:
                self._scatter_chunk(i // SPREAD, slots)

    @ti.func
    def _scatter_chunk(self, chunk, slots):
        offset, segment = self.pairs.chunk_pairs[chunk], ti.static(self.pairs.segment)
        for k in range(slots * chunk // CHUNKS, slots * (chunk + 1) // CHUNKS):
            s = self.projected.order[k]
            first, end = self.projected.first_pair[s], self.projected.end_pair[s]
            for e in range(first, end):
                t = self.pairs.emitted_tile[chunk * segment + e]
                place = self.pairs.histogram[chunk, t]
                self.pairs.histogram[chunk, t] = place + 1
                self.pairs.slot[place] = s
                self.pairs.rows[place] = self.pairs.emitted_rows[chunk * segment + e]
                self.pairs.position[offset + e] = place
            self.projected.first_pair[s] = offset + first
            self.projected.end_pair[s] = offset + end

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
from pipelines.render.cpu.projection import ALPHA_MIN

CHUNKS = 16
# One of these chunks per scheduling chunk, see `fields.runtime.compiled_kernel`.
SPREAD = HANDED_OUT
# Margin around an ellipse [px], far above rounding errors and far below a pixel.
SLACK = 0.01


@ti.func
def ellipse_span(b, c, per_c, det, limit, reach, top_at, low, high):
    """Lowest and highest v on the ellipse a u^2 + 2 b u v + c v^2 <= limit with u in [low, high].

    The remaining arguments are the same for all tiles of a Gaussian: per_c = 1 / c, det = a c - b^2, reach is the
    largest u, and top_at is the u at which v is largest (v is smallest at -top_at). If the range is empty, the result
    has lowest > highest.
    """
    low = ti.max(low, -reach)
    high = ti.min(high, reach)
    # If the extremum lies outside the range, use the nearer end of the range.
    u_top = ti.min(ti.max(top_at, low), high)
    u_bottom = ti.min(ti.max(-top_at, low), high)
    top = (-b * u_top + ti.sqrt(ti.max(limit * c - det * u_top * u_top, 0.0))) * per_c
    bottom = (-b * u_bottom - ti.sqrt(ti.max(limit * c - det * u_bottom * u_bottom, 0.0))) * per_c
    return ti.select(low > high, ti.Vector([1.0, -1.0]), ti.Vector([bottom - SLACK, top + SLACK]))


@ti.func
def first_centre(x):
    """Index of the first pixel whose centre is at x or after it."""
    return ti.cast(ti.ceil(x - 0.5), ti.i32)


@ti.func
def last_centre(x):
    """Index of the last pixel whose centre is at x or before it."""
    return ti.cast(ti.floor(x - 0.5), ti.i32)


@ti.data_oriented
class Binning:
    """Fills `pairs` from `projected` for the view in `view`, in tiles of `tile_width` x `tile_height` pixels."""

    tile_width, tile_height = TILE_WIDTH, TILE_HEIGHT

    def __init__(self, view: ViewField, projected: ProjectedGaussians, pairs: TilePairs) -> None:
        self.view = view
        self.projected = projected
        self.pairs = pairs
        self._total = np.zeros(1, dtype=np.int64)
        self._count, self._scan = CompiledKernel(self._count_chunks), CompiledKernel(self._scan_counts)
        self._scatter = CompiledLoop(self._scatter_chunks, 50)

    def forward(self, exact: bool = True) -> None:
        """Bin the projected Gaussians of the current view.

        Args:
            exact: Ignored on the CPU, where binning is always exact.
        """
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

    @ti.func
    def _ellipse(self, s):
        """Ellipse of slot s: a, b, c of its conic, their determinant, squared reach, reach in x and y, 1 / a, 1 / c."""
        conic = self.projected.conic[s]
        # In float64, since the determinant of a needle would lose all precision in float32.
        a, b, c = ti.cast(conic[0], ti.f64), ti.cast(conic[1], ti.f64), ti.cast(conic[2], ti.f64)
        det = ti.cast(a * c - b * b, self.projected.real)
        opacity = self.projected.opacity[s]
        limit = 2.0 * ti.log(ti.max(opacity, ALPHA_MIN) / ALPHA_MIN)
        reach_x, reach_y = ti.sqrt(limit * conic[2] / det), ti.sqrt(limit * conic[0] / det)
        return ti.Vector([conic[0], conic[1], conic[2], det, limit, reach_x, reach_y, 1.0 / conic[0], 1.0 / conic[2]])

    @ti.func
    def _tile_rows(self, s, e, tiles_y):
        """First tile row that slot s reaches, and the row after the last."""
        reach = e[6] + SLACK
        y = self.projected.mean[s][1]
        first = ti.max(first_centre(y - reach), 0) // self.tile_height
        last = ti.min(last_centre(y + reach), tiles_y * self.tile_height - 1)
        return ti.Vector([first, ti.select(last < 0, 0, last // self.tile_height + 1)])

    @ti.func
    def _tile_columns(self, s, e, tile_y, tiles_x):
        """First tile column that slot s reaches in a tile row, and the column after the last."""
        mean = self.projected.mean[s]
        top = tile_y * self.tile_height + 0.5 - mean[1]
        bottom = top + (self.tile_height - 1)
        span = ellipse_span(e[1], e[0], e[7], e[3], e[4], e[6], -e[1] * e[8] * e[5], top, bottom)
        first = ti.max(first_centre(mean[0] + span[0]), 0)
        last = ti.min(last_centre(mean[0] + span[1]), tiles_x * self.tile_width - 1)
        return ti.select(
            (last < first) | (span[0] > span[1]),
            ti.Vector([0, 0]),
            ti.Vector([first // self.tile_width, last // self.tile_width + 1]),
        )

    @ti.func
    def _pixel_rows(self, s, e, tile_x, tile_y):
        """Rows of a tile that slot s reaches, packed as first | (last + 1) << 16."""
        mean = self.projected.mean[s]
        left = tile_x * self.tile_width + 0.5 - mean[0]
        right = left + (self.tile_width - 1)
        span = ellipse_span(e[1], e[2], e[8], e[3], e[4], e[5], -e[1] * e[7] * e[6], left, right)
        first = ti.max(first_centre(mean[1] + span[0]) - tile_y * self.tile_height, 0)
        last = ti.min(last_centre(mean[1] + span[1]) - tile_y * self.tile_height, self.tile_height - 1)
        return ti.select((last < first) | (span[0] > span[1]), 0, first | ((last + 1) << 16))

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

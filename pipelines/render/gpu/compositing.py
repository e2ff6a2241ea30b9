"""Compositing on a GPU: one block per tile, one thread per pixel, with the tile's Gaussians in shared memory.

The formulas are those of `pipelines/render/cpu/compositing.py`, but each pixel stops by itself once it is opaque. The
backward pass also goes front to back, in the phases of `compositing_gradient.py`.
"""
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportInvalidTypeForm=false, reportOptionalSubscript=false

from fields.buffers.device_pairs import TILE_HEIGHT, TILE_PIXELS, TILE_WIDTH
from fields.buffers.images import PAD, ImageBuffers
from fields.map.gaussians import GaussianField
from fields.runtime.compiled_kernel import CompiledKernel
from fields.runtime.engine import ti
from pipelines.render.formulas import ALPHA_MAX, ALPHA_MIN, OPAQUE
from pipelines.render.gpu.binning import DeviceBinning
from pipelines.render.gpu.compositing_gradient import (
    COLUMNS,
    ROW_BITS,
    STEP,
    SUMS,
    WIDTH,
    add_columns,
    clear_pairs,
    column_sums,
    row_bits,
    unclamped_alpha,
    write_weights,
)
from pipelines.render.gpu.reductions import THREADS, max_over_block

# Number of Gaussians in shared memory at a time in the forward pass; the backward pass has `STEP`.
BATCH = TILE_PIXELS
TILE_BITS = TILE_PIXELS.bit_length() - 1

assert THREADS == TILE_PIXELS == BATCH

INDICES = ti.types.ndarray(dtype=ti.i32, ndim=1)
PLACES = ti.types.ndarray(dtype=ti.i64, ndim=1)
SUMMED = ti.types.ndarray(dtype=ti.f32, ndim=1)


@ti.data_oriented
class DeviceCompositing:
    """Composites `projected` into `images` by the lists in `pairs`, and propagates gradients back."""

    def __init__(self, gaussians: GaussianField, binning: DeviceBinning, images: ImageBuffers) -> None:
        self.gaussians, self.binning, self.images = gaussians, binning, images
        self.view, self.projected, self.pairs = binning.view, binning.projected, binning.pairs
        self._composite, self._add_up = CompiledKernel(self._forward), CompiledKernel(self._gather)
        self._differentiate = {False: CompiledKernel(self._backward), True: CompiledKernel(self._backward_with_depth)}

    def forward(self) -> None:
        pairs = self.pairs
        lists = (pairs.tile, pairs.origin, pairs.emitted_slot, pairs.slot, pairs.rows)
        self._composite(self.view.width, self.view.height, *lists)

    def backward(self, with_depth: bool = False) -> None:
        pairs = self.pairs
        lists = (pairs.slot, pairs.rows, pairs.origin, pairs.gradient)
        self._differentiate[with_depth](self.view.width, self.view.height, *lists)
        self._add_up(pairs.room, pairs.gradient)

    @ti.func
    def _load(self, store: ti.template(), place, s):
        """Copy the values of slot s that compositing reads into shared memory."""
        mean, conic = self.projected.mean[s], self.projected.conic[s]
        colour = self.projected.colour[s]
        store[place] = mean[0]
        store[place + 1] = mean[1]
        store[place + 2] = -0.5 * conic[0]
        store[place + 3] = -conic[1]
        store[place + 4] = -0.5 * conic[2]
        store[place + 5] = self.projected.opacity[s]
        store[place + 6] = colour[0]
        store[place + 7] = colour[1]
        store[place + 8] = colour[2]
        store[place + 9] = self.projected.depth[s]

    @ti.func
    def _write_pixel(self, x, y, red, green, blue, z, T):
        """Write the image of a pixel over the background, with its transmittance T."""
        plane = ti.static(self.images.plane)
        target = (y + PAD) * self.images.stride + x + PAD
        background = self.images.background[None]
        self.images.colour[target] = red + T * background[0]
        self.images.colour[target + plane] = green + T * background[1]
        self.images.colour[target + 2 * plane] = blue + T * background[2]
        self.images.depth[target] = z
        self.images.opacity[target] = 1.0 - T

    @ti.kernel
    def _forward(
        self,
        width: ti.i32,
        height: ti.i32,
        tile_of: ti.types.ndarray(ndim=1),
        origin: PLACES,
        emitted: INDICES,
        slot: INDICES,
        rows: INDICES,
    ):
        tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
        tiles = tiles_x * ((height + TILE_HEIGHT - 1) // TILE_HEIGHT)
        # Bounds of all loops come first: each group of such lines is a launch.
        pixels = tiles * TILE_PIXELS
        for k in range(tile_of.shape[0]):
            self.binning.arrange(k, tiles, tiles_x, tile_of, origin, emitted, slot, rows)

        ti.loop_config(block_dim=TILE_PIXELS)
        for i in range(pixels):
            splats = ti.simt.block.SharedArray((BATCH * WIDTH,), ti.f32)
            spans = ti.simt.block.SharedArray((BATCH,), ti.i32)
            # Whether any pixel of the tile is not opaque yet, alternating between batches.
            open_pixels = ti.simt.block.SharedArray((2,), ti.i32)
            tile, thread = i >> TILE_BITS, i & (TILE_PIXELS - 1)
            row = thread >> ROW_BITS
            bit = 1 << row
            x = tile % tiles_x * TILE_WIDTH + thread % TILE_WIDTH
            y = tile // tiles_x * TILE_HEIGHT + row
            inside = (x < width) & (y < height)
            px, py = ti.cast(x, ti.f32) + 0.5, ti.cast(y, ti.f32) + 0.5
            first, count = self.pairs.first[tile], self.pairs.tile_count[tile]
            T, red, green, blue, z = 1.0, 0.0, 0.0, 0.0, 0.0
            counted = 0
            # Threads of the block may still use shared memory for the previous tile.
            ti.simt.block.sync()
            if thread == 0:
                open_pixels[0] = 0
                open_pixels[1] = 0
            start = 0
            going = count > 0
            while going:
                if start + thread < count:
                    k = first + start + thread
                    self._load(splats, thread * WIDTH, slot[k])
                    spans[thread] = row_bits(rows[k])
                ti.simt.block.sync()
                turn = start // BATCH % 2
                for j in range(ti.select(inside, ti.min(BATCH, count - start), 0)):
                    # LLVM sees from the mask that no index overflows, and makes the offsets of the values constant.
                    at = (j & (BATCH - 1)) * WIDTH
                    if T > OPAQUE and spans[j] & bit:
                        alpha = ti.min(unclamped_alpha(splats, at, px, py), ALPHA_MAX)
                        if alpha >= ALPHA_MIN:
                            weight = alpha * T
                            red += weight * splats[at + 6]
                            green += weight * splats[at + 7]
                            blue += weight * splats[at + 8]
                            z += weight * splats[at + 9]
                            T -= weight
                            counted = start + j + 1
                if inside and T > OPAQUE:
                    open_pixels[turn] = 1
                ti.simt.block.sync()
                start += BATCH
                going = start < count and open_pixels[turn] == 1
                # Reset the flag of the next batch, which is not read before the next barrier.
                if thread == 0:
                    open_pixels[1 - turn] = 0
            # All threads have finished the last batch, whose rows the counts overwrite.
            spans[thread] = counted
            max_over_block(spans, thread)
            if thread == 0:
                self.pairs.reached[tile] = spans[0]
            if inside:
                self._write_pixel(x, y, red, green, blue, z, T)

    @ti.kernel
    def _backward(self, width: ti.i32, height: ti.i32, slot: INDICES, rows: INDICES, origin: PLACES, gradient: SUMMED):
        tiles = ((width + TILE_WIDTH - 1) // TILE_WIDTH) * ((height + TILE_HEIGHT - 1) // TILE_HEIGHT)
        ti.loop_config(block_dim=TILE_PIXELS)
        for i in range(tiles * TILE_PIXELS):
            self._backward_pixel(i, width, height, slot, rows, origin, gradient, False)

    @ti.kernel
    def _backward_with_depth(
        self, width: ti.i32, height: ti.i32, slot: INDICES, rows: INDICES, origin: PLACES, gradient: SUMMED
    ):
        tiles = ((width + TILE_WIDTH - 1) // TILE_WIDTH) * ((height + TILE_HEIGHT - 1) // TILE_HEIGHT)
        ti.loop_config(block_dim=TILE_PIXELS)
        for i in range(tiles * TILE_PIXELS):
            self._backward_pixel(i, width, height, slot, rows, origin, gradient, True)

    @ti.func
    def _image_gradient(self, x, y, with_depth: ti.template()):
        """Gradients of a pixel's red, green, blue and depth, and the contribution of all its Gaussians to the loss."""
        plane = ti.static(self.images.plane)
        source = (y + PAD) * self.images.stride + x + PAD
        red_grad = self.images.colour_grad[source]
        green_grad = self.images.colour_grad[source + plane]
        blue_grad = self.images.colour_grad[source + 2 * plane]
        z_grad = 0.0
        behind = (
            red_grad * self.images.colour[source]
            + green_grad * self.images.colour[source + plane]
            + blue_grad * self.images.colour[source + 2 * plane]
            - self.images.opacity_grad[source] * (1.0 - self.images.opacity[source])
        )
        if ti.static(with_depth):
            z_grad = self.images.depth_grad[source]
            behind += z_grad * self.images.depth[source]
        return red_grad, green_grad, blue_grad, z_grad, behind

    @ti.func
    def _backward_pixel(
        self,
        i,
        width,
        height,
        slot: ti.template(),
        rows: ti.template(),
        origin: ti.template(),
        gradient: ti.template(),
        with_depth: ti.template(),
    ):
        splats = ti.simt.block.SharedArray((STEP * WIDTH,), ti.f32)
        spans = ti.simt.block.SharedArray((STEP,), ti.i32)
        origins = ti.simt.block.SharedArray((STEP,), ti.i32)
        # The four values of a pixel are side by side, and so are its two of phase A: one access loads them.
        image_grad = ti.simt.block.SharedArray((4 * TILE_PIXELS,), ti.f32)
        # First the weights and d loss / d power of phase A, then the sums of phase B.
        weights = ti.simt.block.SharedArray((2 * STEP * TILE_PIXELS,), ti.f32)

        tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
        # Shifts and masks, so that LLVM sees that no index overflows.
        tile, thread = i >> TILE_BITS, i & (TILE_PIXELS - 1)
        column, top = thread & (TILE_WIDTH - 1), tile // tiles_x * TILE_HEIGHT
        x, y = tile % tiles_x * TILE_WIDTH + column, top + (thread >> ROW_BITS)
        px, py = ti.cast(x, ti.f32) + 0.5, ti.cast(y, ti.f32) + 0.5
        # Pixels outside the image are opaque from the start.
        T, behind, grads = 0.0, 0.0, ti.Vector.zero(ti.f32, 4)
        if x < width and y < height:
            T = 1.0
            grads[0], grads[1], grads[2], grads[3], behind = self._image_gradient(x, y, with_depth)
        # Threads of the block may still use shared memory for the previous tile.
        ti.simt.block.sync()
        for c in ti.static(range(3 + with_depth)):
            image_grad[thread * 4 + c] = grads[c]

        first, count, reached = self.pairs.first[tile], self.pairs.tile_count[tile], self.pairs.reached[tile]
        for step in range((reached + STEP - 1) // STEP):
            start = step * STEP
            here = ti.min(STEP, reached - start)
            if thread < here:
                k = first + start + thread
                self._load(splats, thread * WIDTH, slot[k])
                spans[thread] = row_bits(rows[k])
                origins[thread] = ti.cast(origin[k], ti.i32)
            ti.simt.block.sync()
            write_weights(here, thread, px, py, grads, T, behind, splats, spans, weights, with_depth)
            ti.simt.block.sync()
            # Phase B: this thread's Gaussian and column of pixels.
            g = thread >> ROW_BITS
            sums = ti.Vector.zero(ti.f32, SUMS)
            if g < here:
                dx, dy = px - splats[g * WIDTH], ti.cast(top, ti.f32) + 0.5 - splats[g * WIDTH + 1]
                sums = column_sums(g, column, spans[g], dx, dy, weights, image_grad, with_depth)
            ti.simt.block.sync()
            for c in ti.static(range(SUMS)):
                weights[(g * SUMS + c) * COLUMNS + column] = sums[c]
            ti.simt.block.sync()
            add_columns(thread, here, weights, origins, gradient)
            ti.simt.block.sync()
        clear_pairs(thread, first + reached, count - reached, origin, gradient)

    @ti.kernel
    def _gather(self, room: ti.i32, gradient: SUMMED):
        """Sum the pairs of every slot, in order, into the gradients of its composited values.

        Also mark its Gaussian as touched, and clear the gradient of its camera tangent for the projection.

        Each slot has sixteen threads, ten of which compute one sum each, so that they read a pair's gradient together.
        """
        ti.loop_config(block_dim=TILE_PIXELS)
        for i in range((self.projected.seen[None] + 15) // 16 * TILE_PIXELS):
            totals = ti.simt.block.SharedArray((TILE_PIXELS,), ti.f32)
            s, c = i // 16, i % 16
            seen = self.projected.seen[None]
            total = 0.0
            if s < seen and c < SUMS:
                end = ti.min(self.pairs.total[None], room)
                if s + 1 < seen:
                    end = self.projected.first_pair[s + 1]
                for k in range(self.projected.first_pair[s], end):
                    total += gradient[k * SUMS + c]
            totals[i % TILE_PIXELS] = total
            ti.simt.block.sync()
            if s < seen and c == 0:
                at = i % TILE_PIXELS
                conic = self.projected.conic[s]
                self.projected.colour.grad[s] = ti.Vector([totals[at], totals[at + 1], totals[at + 2]])
                self.projected.depth.grad[s] = totals[at + 3]
                self.projected.opacity.grad[s] = totals[at + 4] / ti.max(self.projected.opacity[s], 1e-12)
                self.projected.mean.grad[s] = ti.Vector(
                    [
                        conic[0] * totals[at + 5] + conic[1] * totals[at + 6],
                        conic[1] * totals[at + 5] + conic[2] * totals[at + 6],
                    ]
                )
                self.projected.conic.grad[s] = ti.Vector(
                    [-0.5 * totals[at + 7], -totals[at + 8], -0.5 * totals[at + 9]]
                )
                self.projected.tangent.grad[s].fill(0.0)
                self.gaussians.touched[self.projected.gaussian[s]] = 1
            ti.simt.block.sync()

"""Compositing of the sorted ellipses to colour, depth and opacity, forward and backward, with one task per tile.

Front to back, with T the transmittance before a Gaussian (Eq. 3 of 3DGS):
    alpha = min(0.99, opacity * exp(power)),  power = -(a dx^2 + c dy^2) / 2 - b dx dy
    C += alpha T c,   D += alpha T z,   T *= 1 - alpha,   and at the end   C += T background.

The outer loop runs over Gaussians and the inner loop over the consecutive pixels of a tile's rows, the opposite of a
GPU implementation. The inner loop has no branches, so that it compiles to SIMD code. Only rows that the ellipse reaches
are visited.
"""
# pyright: reportArgumentType=false, reportInvalidTypeForm=false, reportOptionalSubscript=false

from fields.buffers.images import PAD, ImageBuffers
from fields.buffers.tiles import GROUP, TILE_HEIGHT, TILE_PIXELS, TILE_WIDTH, TilePairs
from fields.buffers.view import ProjectedGaussians, ViewField
from fields.runtime.compiled_kernel import HANDED_OUT, CompiledKernel, CompiledLoop
from fields.runtime.engine import ti
from pipelines.render.formulas import ALPHA_MAX, ALPHA_MIN, OPAQUE

# Lower bound of the transmittance: far below what is visible, and above denormal numbers, which are slow.
LEAST_TRANSMITTANCE = 1e-20
ROW_BITS = TILE_WIDTH.bit_length() - 1
# Eight tiles per chunk, see `fields.runtime.compiled_kernel`.
SPREAD = HANDED_OUT // 8


@ti.data_oriented
class Compositing:
    """Composites `projected` into `images` by the lists in `pairs`, and propagates gradients back."""

    def __init__(self, view: ViewField, projected: ProjectedGaussians, pairs: TilePairs, images: ImageBuffers) -> None:
        self.view = view
        self.projected = projected
        self.pairs = pairs
        self.images = images
        self.real = images.real
        self._composite, self._add_up = CompiledKernel(self._forward), CompiledLoop(self._gather, 80)
        self._differentiate = {False: CompiledKernel(self._backward), True: CompiledKernel(self._backward_with_depth)}

    def forward(self) -> None:
        self._composite(self.view.width, self.view.height)

    def backward(self, with_depth: bool = False) -> None:
        self._differentiate[with_depth](self.view.width, self.view.height)
        self._add_up(self.projected.count, self.projected.count)

    @ti.kernel
    def _forward(self, width: ti.i32, height: ti.i32):
        tiles = ((width + TILE_WIDTH - 1) // TILE_WIDTH) * ((height + TILE_HEIGHT - 1) // TILE_HEIGHT)
        for spread in range(tiles * SPREAD):
            if spread % SPREAD == 0:
                self._forward_tile(spread // SPREAD, width, height)

    @ti.func
    def _forward_tile(self, tile, width, height):
        tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
        base = tile * TILE_PIXELS
        for p in range(TILE_PIXELS):
            self.images.transmittance[base + p] = 1.0
            self.images.red[base + p] = 0.0
            self.images.green[base + p] = 0.0
            self.images.blue[base + p] = 0.0
            self.images.z[base + p] = 0.0
        # Pixel centres relative to the mean, without the half pixel.
        left = ti.cast(tile % tiles_x * TILE_WIDTH, self.real) + 0.5
        top = ti.cast(tile // tiles_x * TILE_HEIGHT, self.real) + 0.5
        first, count = self.pairs.first[tile], self.pairs.tile_count[tile]
        reached = 0
        not_opaque = ti.cast(1.0, self.real)
        for group in range((count + GROUP - 1) // GROUP):
            # An empty range instead of a `while` or `break`, with which Taichi fetches every field's root at each
            # pixel, and LLVM does not vectorise the inner loop.
            start = first + group * GROUP
            end = ti.select(not_opaque > 0.0, ti.min(start + GROUP, first + count), start)
            self._stage(tile, start, end, left, top)
            for k in range(start, end):
                rows, ellipse = self.pairs.rows[k], self.pairs.staged[tile * GROUP + k - start]
                x0, y0, a, b, c = ellipse[0], ellipse[1], ellipse[2], ellipse[3], ellipse[4]
                opacity, z = ellipse[5], ellipse[9]
                colour = ti.Vector([ellipse[6], ellipse[7], ellipse[8]])
                for p in range((rows & 0xFFFF) << ROW_BITS, (rows >> 16) << ROW_BITS):
                    dx = x0 + ti.cast(p & (TILE_WIDTH - 1), self.real)
                    dy = y0 + ti.cast(p >> ROW_BITS, self.real)
                    power = (a * dx + b * dy) * dx + c * dy * dy
                    alpha = opacity * fast_exp2(power, self.real)
                    alpha = ti.select(alpha < ALPHA_MAX, alpha, ALPHA_MAX)
                    alpha = ti.select(alpha >= ALPHA_MIN, alpha, 0.0)
                    T = self.images.transmittance[base + p]
                    weight = alpha * T
                    self.images.red[base + p] = self.images.red[base + p] + weight * colour[0]
                    self.images.green[base + p] = self.images.green[base + p] + weight * colour[1]
                    self.images.blue[base + p] = self.images.blue[base + p] + weight * colour[2]
                    self.images.z[base + p] = self.images.z[base + p] + weight * z
                    T -= weight
                    self.images.transmittance[base + p] = ti.select(T > LEAST_TRANSMITTANCE, T, LEAST_TRANSMITTANCE)
            reached = ti.select(end > start, end - first, reached)
            # Count the pixels, since LLVM vectorises a sum but not a maximum of floats.
            not_opaque = ti.cast(0.0, self.real)
            for p in range(TILE_PIXELS):
                not_opaque += ti.select(self.images.transmittance[base + p] > OPAQUE, 1.0, 0.0)
        self.pairs.reached[tile] = reached
        self._store_tile(tile, width, height)

    @ti.func
    def _store_tile(self, tile, width, height):
        """Copy a composited tile to the image."""
        tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
        base = tile * TILE_PIXELS
        stride, plane = ti.static(self.images.stride, self.images.plane)
        columns = ti.min(TILE_WIDTH, width - tile % tiles_x * TILE_WIDTH)
        background = self.images.background[None]
        for row in range(ti.min(TILE_HEIGHT, height - tile // tiles_x * TILE_HEIGHT)):
            source = base + row * TILE_WIDTH
            target = (tile // tiles_x * TILE_HEIGHT + row + PAD) * stride + tile % tiles_x * TILE_WIDTH + PAD
            for x in range(columns):
                T = self.images.transmittance[source + x]
                self.images.colour[target + x] = self.images.red[source + x] + T * background[0]
                self.images.colour[target + plane + x] = self.images.green[source + x] + T * background[1]
                self.images.colour[target + 2 * plane + x] = self.images.blue[source + x] + T * background[2]
                self.images.depth[target + x] = self.images.z[source + x]
                self.images.opacity[target + x] = 1.0 - T

    @ti.func
    def _stage(self, tile, start, end, left, top):
        """Copy the Gaussians of a group of pairs into contiguous memory that stays in the cache.

        Neighbours in a tile's list are far apart in memory. Here, the cache misses of a group overlap. One after the
        other, in the loop over pairs, they took a sixth of the time.
        """
        for k in range(start, end):
            s = self.pairs.slot[k]
            mean, conic, colour = self.projected.mean[s], self.projected.conic[s], self.projected.colour[s]
            self.pairs.staged[tile * GROUP + k - start] = ti.Vector(
                [
                    left - mean[0], top - mean[1],
                    -0.5 * LOG2E * conic[0], -LOG2E * conic[1], -0.5 * LOG2E * conic[2],
                    self.projected.opacity[s], colour[0], colour[1], colour[2], self.projected.depth[s],
                ]
            )  # fmt: skip

    @ti.kernel
    def _backward(self, width: ti.i32, height: ti.i32):
        self._backward_tiles(width, height, False)

    @ti.kernel
    def _backward_with_depth(self, width: ti.i32, height: ti.i32):
        self._backward_tiles(width, height, True)

    @ti.func
    def _backward_tiles(self, width, height, with_depth: ti.template()):
        # Front to back, like the forward pass, so that the same Gaussians are masked and skipped. Everything behind a
        # Gaussian enters as one number per pixel: `behind` = <gradient, all that is still to be composited>.
        tiles = ((width + TILE_WIDTH - 1) // TILE_WIDTH) * ((height + TILE_HEIGHT - 1) // TILE_HEIGHT)
        for spread in range(tiles * SPREAD):
            if spread % SPREAD == 0:
                self._backward_tile(spread // SPREAD, width, height, with_depth)

    @ti.func
    def _load_gradients(self, tile, width, height, with_depth: ti.template()):
        """Copy a tile's gradients from the image, with `behind` and the transmittance as before the first Gaussian."""
        tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
        base = tile * TILE_PIXELS
        for p in range(TILE_PIXELS):
            self.images.transmittance[base + p] = 1.0
            self.images.behind[base + p] = 0.0
            self.images.red_grad[base + p] = 0.0
            self.images.green_grad[base + p] = 0.0
            self.images.blue_grad[base + p] = 0.0
            if ti.static(with_depth):
                self.images.z_grad[base + p] = 0.0
        stride, plane = ti.static(self.images.stride, self.images.plane)
        columns = ti.min(TILE_WIDTH, width - tile % tiles_x * TILE_WIDTH)
        for row in range(ti.min(TILE_HEIGHT, height - tile // tiles_x * TILE_HEIGHT)):
            target = base + row * TILE_WIDTH
            source = (tile // tiles_x * TILE_HEIGHT + row + PAD) * stride + tile % tiles_x * TILE_WIDTH + PAD
            for x in range(columns):
                red_grad = self.images.colour_grad[source + x]
                green_grad = self.images.colour_grad[source + plane + x]
                blue_grad = self.images.colour_grad[source + 2 * plane + x]
                behind = (
                    red_grad * self.images.colour[source + x]
                    + green_grad * self.images.colour[source + plane + x]
                    + blue_grad * self.images.colour[source + 2 * plane + x]
                    - self.images.opacity_grad[source + x] * (1.0 - self.images.opacity[source + x])
                )
                if ti.static(with_depth):
                    z_grad = self.images.depth_grad[source + x]
                    self.images.z_grad[target + x] = z_grad
                    behind = behind + z_grad * self.images.depth[source + x]
                self.images.red_grad[target + x] = red_grad
                self.images.green_grad[target + x] = green_grad
                self.images.blue_grad[target + x] = blue_grad
                self.images.behind[target + x] = behind

    @ti.func
    def _backward_tile(self, tile, width, height, with_depth: ti.template()):
        self._load_gradients(tile, width, height, with_depth)
        tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
        base = tile * TILE_PIXELS
        left = ti.cast(tile % tiles_x * TILE_WIDTH, self.real) + 0.5
        top = ti.cast(tile // tiles_x * TILE_HEIGHT, self.real) + 0.5
        first, reached = self.pairs.first[tile], self.pairs.reached[tile]
        for group in range((reached + GROUP - 1) // GROUP):
            start = first + group * GROUP
            end = ti.min(start + GROUP, first + reached)
            self._stage(tile, start, end, left, top)
            for k in range(start, end):
                rows, ellipse = self.pairs.rows[k], self.pairs.staged[tile * GROUP + k - start]
                x0, y0, a, b, c = ellipse[0], ellipse[1], ellipse[2], ellipse[3], ellipse[4]
                opacity, z = ellipse[5], ellipse[9]
                colour = ti.Vector([ellipse[6], ellipse[7], ellipse[8]])
                zero = ti.cast(0.0, self.real)
                g_red, g_green, g_blue, g_z, g_power = zero, zero, zero, zero, zero
                g_x, g_y, g_xx, g_xy, g_yy = zero, zero, zero, zero, zero
                for p in range((rows & 0xFFFF) << ROW_BITS, (rows >> 16) << ROW_BITS):
                    dx = x0 + ti.cast(p & (TILE_WIDTH - 1), self.real)
                    dy = y0 + ti.cast(p >> ROW_BITS, self.real)
                    power = (a * dx + b * dy) * dx + c * dy * dy
                    unclamped = opacity * fast_exp2(power, self.real)
                    alpha = ti.select(unclamped < ALPHA_MAX, unclamped, ALPHA_MAX)
                    alpha = ti.select(alpha >= ALPHA_MIN, alpha, 0.0)
                    T = self.images.transmittance[base + p]
                    weight = alpha * T
                    red_grad = self.images.red_grad[base + p]
                    green_grad = self.images.green_grad[base + p]
                    blue_grad = self.images.blue_grad[base + p]
                    shade = colour[0] * red_grad + colour[1] * green_grad + colour[2] * blue_grad
                    if ti.static(with_depth):
                        shade = shade + z * self.images.z_grad[base + p]
                        g_z += weight * self.images.z_grad[base + p]
                    contribution = weight * shade
                    behind = self.images.behind[base + p] - contribution
                    self.images.behind[base + p] = behind
                    T -= weight
                    self.images.transmittance[base + p] = ti.select(T > LEAST_TRANSMITTANCE, T, LEAST_TRANSMITTANCE)
                    # d loss / d power = alpha * d loss / d alpha, and 0 where alpha is clamped.
                    power_grad = contribution - behind * alpha / (1.0 - alpha)
                    power_grad = ti.select(unclamped > ALPHA_MAX, 0.0, power_grad)
                    g_red += weight * red_grad
                    g_green += weight * green_grad
                    g_blue += weight * blue_grad
                    g_power += power_grad
                    ux, uy = power_grad * dx, power_grad * dy
                    g_x += ux
                    g_y += uy
                    g_xx += ux * dx
                    g_xy += ux * dy
                    g_yy += uy * dy
                self.pairs.gradient[k] = ti.Vector([g_red, g_green, g_blue, g_z, g_power, g_x, g_y, g_xx, g_xy, g_yy])
        for k in range(first + reached, first + self.pairs.tile_count[tile]):
            self.pairs.gradient[k].fill(0.0)

    @ti.kernel
    def _gather(self, alone: ti.template(), slots: ti.i32):
        """Sum the pairs of every slot, in order, into the gradients of its composited values."""
        ti.loop_config(serialize=alone)
        for s in range(slots):
            total = ti.Vector.zero(self.real, 10)
            for e in range(self.projected.first_pair[s], self.projected.end_pair[s]):
                total += self.pairs.gradient[self.pairs.position[e]]
            conic = self.projected.conic[s]
            self.projected.colour.grad[s] = ti.Vector([total[0], total[1], total[2]])
            self.projected.depth.grad[s] = total[3]
            self.projected.opacity.grad[s] = total[4] / ti.max(self.projected.opacity[s], 1e-12)
            self.projected.mean.grad[s] = ti.Vector(
                [conic[0] * total[5] + conic[1] * total[6], conic[1] * total[5] + conic[2] * total[6]]
            )
            self.projected.conic.grad[s] = ti.Vector([-0.5 * total[7], -total[8], -0.5 * total[9]])


LOG2E = 1.4426950408889634


@ti.func
def fast_exp2(x, real: ti.template()):
    """2^x for x <= 0. In float32 with a relative error below 4e-7, and about 2e-38 below -125; in float64 by pow.

    The result is 2^n, by its exponent bits, times a minimax polynomial of 2^f, where n is the truncation of x and f is
    in (-1, 0]. Truncation converts to an integer and back, since Taichi's fast-math would cancel the trick of rounding
    by adding a large number. `select` replaces `max`, which would handle NaN.
    """
    result = ti.cast(0.0, real)
    if ti.static(real == ti.f32):
        t = ti.select(x > -125.0, x, -125.0)
        n = ti.cast(t, ti.i32)
        f = t - ti.cast(n, ti.f32)
        p = 0.99999994 + f * (0.69314224 + f * (0.2401722 + f * (0.055279724 + f * (0.009188612 + f * 0.00093878835))))
        result = ti.bit_cast(ti.bit_cast(p, ti.i32) + (n << 23), ti.f32)
    else:
        result = ti.pow(ti.cast(2.0, real), x)
    return result

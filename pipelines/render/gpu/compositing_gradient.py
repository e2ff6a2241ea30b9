"""Phases of the backward pass of compositing on a GPU, over a tile's Gaussians in shared memory.

The pass goes front to back and sums without atomics, in three phases for every 16 Gaussians:
    A  one thread per pixel writes the weight and d loss / d power of each Gaussian to shared memory,
    B  one thread per (Gaussian, column of pixels) computes ten sums over the rows that the ellipse reaches,
    C  one thread per (Gaussian, sum) adds the columns.
This takes about ten accesses to shared memory per pixel and Gaussian, compared with some fifty shuffles for a
reduction over the warps, and the order of the sums is fixed.
"""
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportInvalidTypeForm=false, reportOptionalSubscript=false

from fields.buffers.device_pairs import TILE_PIXELS, TILE_WIDTH
from fields.runtime.engine import ti
from pipelines.render.formulas import ALPHA_MAX, ALPHA_MIN, OPAQUE

# Number of Gaussians in shared memory at a time.
STEP = 16
# Values of a Gaussian in shared memory: mean (2), conic (3), opacity, colour (3), depth.
WIDTH = 10
ROW_BITS = TILE_WIDTH.bit_length() - 1
# Stride in shared memory between the columns of two sums, padded so that the 32 sums of a warp's threads use different
# banks.
COLUMNS = TILE_WIDTH + 1
# Sums of a Gaussian: the gradients of colour (3), depth and opacity, then the five moments that mean and conic need.
SUMS = 10


@ti.func
def row_bits(rows):
    """Rows of a tile that a pair reaches, as a bit each in the lower half, and the first of them in the upper half.

    rows: Packed as first | (last + 1) << 16; see `TilePairs.rows`.
    """
    first = rows & 0xFFFF
    return ((1 << (rows >> 16)) - (1 << first)) | (first << 16)


@ti.func
def unclamped_alpha(splats: ti.template(), at, px, py):
    """Opacity times the Gaussian at a pixel, for the values at `at` in shared memory."""
    dx, dy = px - splats[at], py - splats[at + 1]
    power = (splats[at + 2] * dx + splats[at + 3] * dy) * dx + splats[at + 4] * dy * dy
    return splats[at + 5] * ti.exp(power)


@ti.func
def write_weights(
    here,
    thread,
    px,
    py,
    grads,
    T: ti.template(),
    behind: ti.template(),
    splats: ti.template(),
    spans: ti.template(),
    weights: ti.template(),
    with_depth: ti.template(),
):
    """Phase A: weights and gradients of the step's `here` Gaussians at this thread's pixel.

    grads: Gradients of the pixel's red, green, blue and depth.
    T, behind: Transmittance, and contributions of the Gaussians that are still to come; carried from step to step.
    """
    bit = 1 << (thread >> ROW_BITS)
    for j in range(here):
        at = j * WIDTH
        if spans[j] & bit:
            weight, power_grad = 0.0, 0.0
            unclamped = unclamped_alpha(splats, at, px, py)
            alpha = ti.min(unclamped, ALPHA_MAX)
            if alpha >= ALPHA_MIN and T > OPAQUE:
                weight = alpha * T
                shade = splats[at + 6] * grads[0] + splats[at + 7] * grads[1] + splats[at + 8] * grads[2]
                if ti.static(with_depth):
                    shade += splats[at + 9] * grads[3]
                contribution = weight * shade
                behind -= contribution
                T -= weight
                # d loss / d power = alpha * d loss / d alpha, and 0 where alpha is clamped.
                if unclamped <= ALPHA_MAX:
                    power_grad = contribution - behind * alpha / (1.0 - alpha)
            pixel = 2 * ((j & (STEP - 1)) * TILE_PIXELS + thread)
            weights[pixel] = weight
            weights[pixel + 1] = power_grad


@ti.func
def column_sums(
    g,
    column,
    span,
    dx,
    dy,
    weights: ti.template(),
    image_grad: ti.template(),
    with_depth: ti.template(),
):
    """Phase B: sums of the step's g-th Gaussian over its rows of one column.

    span: Its rows, from `row_bits`.
    dx, dy: From the Gaussian's mean to the column's first pixel.
    """
    s_red, s_green, s_blue, s_z = 0.0, 0.0, 0.0, 0.0
    s, s_y, s_yy = 0.0, 0.0, 0.0
    r, bits = span >> 16, span & 0xFFFF
    # Not a loop over a range, which NVIDIA's assembler would unroll four times. That takes 80 to 91 registers instead
    # of 64, and leaves room for two or three blocks on a multiprocessor instead of four (scripts/gpu_report).
    while (bits >> r) & 1:
        pixel = ((r << ROW_BITS) & (TILE_PIXELS - 1)) | column
        weight = weights[2 * (g * TILE_PIXELS + pixel)]
        power_grad = weights[2 * (g * TILE_PIXELS + pixel) + 1]
        s_red += weight * image_grad[4 * pixel]
        s_green += weight * image_grad[4 * pixel + 1]
        s_blue += weight * image_grad[4 * pixel + 2]
        if ti.static(with_depth):
            s_z += weight * image_grad[4 * pixel + 3]
        down = dy + ti.cast(r, ti.f32)
        u = power_grad * down
        s += power_grad
        s_y += u
        s_yy += u * down
        r += 1
    return ti.Vector([s_red, s_green, s_blue, s_z, s, s * dx, s_y, s * dx * dx, s_y * dx, s_yy])


@ti.func
def add_columns(thread, here, sums: ti.template(), origins: ti.template(), gradient: ti.template()):
    """Phase C: add the columns of this thread's Gaussian and sum."""
    if thread < here * SUMS:
        total = 0.0
        for q in range(TILE_WIDTH):
            total += sums[thread * COLUMNS + q]
        gradient[origins[thread // SUMS] * SUMS + thread % SUMS] = total


@ti.func
def clear_pairs(thread, start, count, origin: ti.template(), gradient: ti.template()):
    """Set the gradients of `count` pairs from `start` on to zero."""
    for k in range(count * SUMS // TILE_PIXELS + 1):
        entry = k * TILE_PIXELS + thread
        if entry < count * SUMS:
            place = ti.cast(origin[start + entry // SUMS], ti.i32)
            gradient[place * SUMS + entry % SUMS] = 0.0

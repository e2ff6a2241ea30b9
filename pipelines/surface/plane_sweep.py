"""`PlaneSweep`: compares a view with its neighbours over inverse depth, and picks the depth of least smoothed cost."""
# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportIndexIssue=false

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.runtime.backend import on_gpu
from fields.runtime.compiled_kernel import HANDED_OUT
from fields.runtime.engine import ti

# Most sweep steps, both directions and the middle one.
MAX_STEPS = 33
# A constant added to the variance of matching windows, which suppresses weaker contrast.
LEAST_VARIANCE = 1e-5
# Costs are 1 - ZNCC. Penalties: a change by one step between adjacent pixels; a larger change, which decreases with
# their grey difference on the scale GREY_EDGE; and the distance from the start, relative to the sweep's range. The last
# one only breaks ties: with 0.05, whole regions stayed at the map's depth.
SMALL_JUMP, LARGE_JUMP, GREY_EDGE = 0.05, 0.6, 0.05
START_WEIGHT = 0.002
# Least number of neighbours on one side that may decide alone, and on the other one.
LEAST_SIDE = 4.0
# Grey value outside of an image.
OUTSIDE = -99.0
# Eight rows per chunk, see `fields.runtime.compiled_kernel`.
SPREAD = HANDED_OUT // 8
# Number of pixels of a row whose results the inner loops keep in local arrays. LLVM vectorises a loop that writes to a
# local array, as nothing that it reads can change meanwhile; and one that copies such an array to a field, if the
# kernel reads a field before the loop, so that the address of all fields is known: three times faster in all.
LANES = 64

IMAGE = ti.types.ndarray(dtype=ti.f32, ndim=2)


@ti.data_oriented
class PlaneSweep:
    """Sweeps inverse depth around a start for each pixel [Collins 1996], and smooths the costs [Hirschmueller 2008].

    Windows of 3x3 pixels are compared by ZNCC. A surface behind an edge is hidden from the neighbours on one side, so
    the cost is the least of the means over all neighbours and over those of each side, by the direction in which they
    see a pixel move with its depth: two sides for each diagonal of the four quadrants around the main direction.
    Costs are summed along rows and columns.

    Args:
        pixels: Most pixels of a view.
        steps: Most steps of a sweep of such a view.
    """

    def __init__(self, pixels: int, steps: int) -> None:
        # Powers of two, so that most sizes share the kernels of the offline cache.
        samples = 1 << (pixels * steps - 1).bit_length()
        self.carried = ti.field(ti.f32, samples)
        self.total = ti.field(ti.f32, 4 * samples)  # of each quadrant
        self.count = ti.field(ti.i32, samples)  # of the neighbours in each quadrant, a byte for each
        self.cost = ti.field(ti.f32, samples)
        self.paths = ti.field(ti.f32, samples)
        self.offset = ti.field(ti.f32, MAX_STEPS)  # of inverse depth, of each step
        self.quadrant = ti.field(ti.i32, 255)  # of each neighbour
        self.line = ti.field(ti.f32, 2 * MAX_STEPS * 4096)

    def sweep(
        self,
        grey: NDArray[np.float32],
        others: Sequence[NDArray[np.float32]],
        warps: Sequence[NDArray[np.float32]],
        inverse: NDArray[np.float32],
        step: float,
        reach: int,
    ) -> NDArray[np.float32]:
        """Sweep `reach` steps to either side, and return the inverse depth (H, W) of least smoothed cost.

        Args:
            grey: (H, W) image of the view in [0, 1].
            others: (H, W) images of the neighbours.
            warps: (3, 4) warp to each neighbour, see `plane_warp`.
            inverse: (H, W) inverse depth to start from.
            step: Step of inverse depth.
            reach: Number of steps to either side.
        """
        height, width = grey.shape
        steps = 2 * reach + 1
        mean = cv2.blur(grey, (3, 3))
        variance = np.maximum(cv2.blur(grey * grey, (3, 3)) - mean * mean, 0.0)
        scale = (1.0 / np.sqrt(variance + LEAST_VARIANCE)).astype(np.float32)
        spread = 1 if on_gpu() else SPREAD
        self._begin(_quadrants(warps), step, reach, height * width)
        for neighbour, (other, warp) in enumerate(zip(others, warps, strict=True)):
            self._carry(other, warp, inverse, steps)
            self._compare(grey, mean, scale, neighbour, steps)
        self._combine(reach, height, width)
        self._smooth(grey, steps, spread)
        found = np.empty_like(grey)
        self._pick(inverse, step, reach, found)
        return found

    @ti.kernel
    def _begin(self, quadrants: ti.types.ndarray(dtype=ti.i32, ndim=1), step: ti.f32, reach: ti.i32, pixels: ti.i32):
        """Set the offsets of the steps and the quadrants of the neighbours, and clear the totals."""
        samples = (2 * reach + 1) * pixels
        for i in range(samples):
            self.count[i] = 0
            for q in ti.static(range(4)):
                self.total[q * samples + i] = 0.0
        for d in range(2 * reach + 1):
            self.offset[d] = step * (d - reach)
        for n in range(quadrants.shape[0]):
            self.quadrant[n] = quadrants[n]

    @ti.kernel
    def _carry(self, other: IMAGE, warp: IMAGE, inverse: IMAGE, steps: ti.i32):
        """Warp the neighbour's image to the view, for each step: carried[d, y, x]."""
        height, width = inverse.shape[0], inverse.shape[1]
        right, bottom = other.shape[1] - 1.0, other.shape[0] - 1.0
        for i in range(steps * height):
            offset, y = self.offset[i // height], i % height
            v = y + 0.5
            ax, ay, az = warp[0, 0], warp[1, 0], warp[2, 0]
            bx, by, bz = warp[0, 1] * v + warp[0, 2], warp[1, 1] * v + warp[1, 2], warp[2, 1] * v + warp[2, 2]
            cx, cy, cz = warp[0, 3], warp[1, 3], warp[2, 3]
            values = ti.Vector([0.0] * LANES)
            for group in range((width + LANES - 1) // LANES):
                first = group * LANES
                lanes = ti.min(LANES, width - first)
                for k in range(lanes):
                    u, w = first + k + 0.5, inverse[y, first + k] + offset
                    over = 1.0 / ti.max(az * u + bz + cz * w, 1e-3)
                    px, py = (ax * u + bx + cx * w) * over - 0.5, (ay * u + by + cy * w) * over - 0.5
                    inside = (px >= 0.0) & (py >= 0.0) & (px < right) & (py < bottom)
                    x0, y0 = ti.cast(ti.select(inside, px, 0.0), ti.i32), ti.cast(ti.select(inside, py, 0.0), ti.i32)
                    s, t = px - x0, py - y0
                    above = other[y0, x0] + s * (other[y0, x0 + 1] - other[y0, x0])
                    below = other[y0 + 1, x0] + s * (other[y0 + 1, x0 + 1] - other[y0 + 1, x0])
                    values[k] = ti.select(inside, above + t * (below - above), OUTSIDE)
                for k in range(lanes):
                    self.carried[i * width + first + k] = values[k]

    @ti.kernel
    def _compare(self, grey: IMAGE, mean: IMAGE, scale: IMAGE, neighbour: ti.i32, steps: ti.i32):
        """Add 1 - ZNCC of the 3x3 windows of the view and of `carried` to the total of the neighbour's quadrant."""
        height, width = grey.shape[0], grey.shape[1]
        for i in range(steps * (height - 2)):
            d, y = i // (height - 2), 1 + i % (height - 2)
            row, quadrant = (d * height + y) * width, self.quadrant[neighbour]
            to, one = quadrant * steps * height * width + row, 1 << 8 * quadrant
            costs, counts = ti.Vector([0.0] * LANES), ti.Vector([0] * LANES)
            for group in range((width - 2 + LANES - 1) // LANES):
                first = 1 + group * LANES
                lanes = ti.min(LANES, width - 1 - first)
                for k in range(lanes):
                    x = first + k
                    total, square, product = 0.0, 0.0, 0.0
                    for r, c in ti.static(ti.ndrange(3, 3)):
                        value = self.carried[row + (r - 1) * width + x + c - 1]
                        total += value
                        square += value * value
                        product += value * grey[y + r - 1, x + c - 1]
                    total /= 9.0
                    spread = ti.max(square / 9.0 - total * total, 0.0) + LEAST_VARIANCE
                    together = product / 9.0 - total * mean[y, x]
                    inside = total >= 0.0  # the whole window is
                    costs[k] = ti.select(inside, 1.0 - together * scale[y, x] / ti.sqrt(spread), 0.0)
                    counts[k] = ti.select(inside, one, 0)
                for k in range(lanes):
                    self.total[to + first + k] = self.total[to + first + k] + costs[k]
                    self.count[row + first + k] = self.count[row + first + k] + counts[k]

    @ti.kernel
    def _combine(self, reach: ti.i32, height: ti.i32, width: ti.i32):
        """cost[y, x, d] from the totals of the quadrants; 1 where no neighbour sees the pixel."""
        steps, pixels = 2 * reach + 1, height * width
        for i in range(pixels):
            for d in range(steps):
                n, total = ti.Vector([0.0, 0.0, 0.0, 0.0]), ti.Vector([0.0, 0.0, 0.0, 0.0])
                for q in ti.static(range(4)):
                    n[q] = ti.cast((self.count[d * pixels + i] >> 8 * q) & 255, ti.f32)
                    total[q] = self.total[(q * steps + d) * pixels + i]
                cost = 1.0
                if n.sum() > 0.0:
                    cost = total.sum() / n.sum()
                for q in ti.static(range(4)):
                    side = n[q] + n[(q + 1) % 4]
                    if side >= LEAST_SIDE and n.sum() - side >= LEAST_SIDE:
                        cost = ti.min(cost, (total[q] + total[(q + 1) % 4]) / side)
                self.cost[i * steps + d] = cost + START_WEIGHT * ti.abs(d - reach) / reach
                self.paths[i * steps + d] = 0.0

    @ti.kernel
    def _smooth(self, grey: IMAGE, steps: ti.i32, spread: ti.i32):
        """Sum the costs of the best paths to each pixel along its row and column, from both sides, into `paths`."""
        height, width = grey.shape[0], grey.shape[1]
        for i in range(height * spread):
            if i % spread == 0:
                y = i // spread
                for backwards in range(2):
                    self._walk(grey, steps, y, width, y, 0, 0, 1, backwards)
        for i in range(width * spread):
            if i % spread == 0:
                x = i // spread
                for backwards in range(2):
                    self._walk(grey, steps, x, height, 0, x, 1, 0, backwards)

    @ti.func
    def _walk(self, grey: ti.template(), steps, number, length, row, column, down, across, backwards):
        """Add the costs of the best paths along one line to `paths`."""
        width = grey.shape[1]
        here, before = 2 * number * MAX_STEPS, (2 * number + 1) * MAX_STEPS
        least, grey_before = 0.0, 0.0
        for k in range(length):
            j = ti.select(backwards == 1, length - 1 - k, k)
            y, x = row + j * down, column + j * across
            at = (y * width + x) * steps
            value = grey[y, x]
            jump = ti.max(LARGE_JUMP * ti.exp(-ti.abs(value - grey_before) / GREY_EDGE), 1.5 * SMALL_JUMP)
            lowest = 1e30
            for d in range(steps):
                cost = self.cost[at + d]
                if k > 0:
                    best = ti.min(self.line[before + d], least + jump)
                    best = ti.min(best, self.line[before + ti.max(d - 1, 0)] + SMALL_JUMP)
                    best = ti.min(best, self.line[before + ti.min(d + 1, steps - 1)] + SMALL_JUMP)
                    cost += best - least
                self.line[here + d] = cost
                lowest = ti.min(lowest, cost)
                self.paths[at + d] = self.paths[at + d] + cost
            here, before = before, here
            least, grey_before = lowest, value

    @ti.kernel
    def _pick(self, inverse: IMAGE, step: ti.f32, reach: ti.i32, found: IMAGE):
        """Inverse depth of the least path cost, with a parabola between steps."""
        steps, width = 2 * reach + 1, inverse.shape[1]
        for i in range(inverse.shape[0] * width):
            y, x = i // width, i % width
            best, at = 0, i * steps
            for d in range(1, steps):
                if self.paths[at + d] < self.paths[at + best]:
                    best = d
            best = ti.min(ti.max(best, 1), steps - 2)
            left, middle, right = self.paths[at + best - 1], self.paths[at + best], self.paths[at + best + 1]
            curvature = ti.max(left + right - 2.0 * middle, 1e-6)
            offset = ti.min(ti.max((left - right) / (2.0 * curvature), -0.5), 0.5)
            found[y, x] = inverse[y, x] + step * (best + offset - reach)


def _quadrants(warps: Sequence[NDArray[np.float32]]) -> NDArray[np.int32]:
    """Return the quadrant, 0 to 3, of the direction in which each neighbour sees a pixel move with its inverse depth.

    Quadrants 0 and 2 lie around the main direction of all neighbours.
    """
    moves = np.array([warp[:2, 3] for warp in warps], dtype=np.float64)
    moves /= np.maximum(np.linalg.norm(moves, axis=1, keepdims=True), 1e-9)
    along = np.linalg.svd(moves)[2][0]
    angles = np.arctan2(moves @ (-along[1], along[0]), moves @ along)
    return np.floor(angles / (np.pi / 2) + 0.5).astype(np.int32) % 4

"""Depth from a search along epipolar lines in neighbouring keyframes."""
# pyright: reportInvalidTypeForm=false

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from fields.map.keyframe import Keyframe
from fields.runtime.backend import on_gpu
from fields.runtime.compiled_kernel import HANDED_OUT
from fields.runtime.engine import ti
from pipelines.densify.depth.estimate import DepthEstimate, point_depths, unknown_depth
from pipelines.settings import EpipolarSettings


def plane_warp(
    camera: PinholeCamera,
    T_camera_world: NDArray[np.float64],
    other: PinholeCamera,
    T_other_world: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Warp from a view to another one, for points at a given inverse depth.

    Args:
        camera: Camera of the view.
        T_camera_world: Pose (4, 4) of the view.
        other: Camera of the other view.
        T_other_world: Pose (4, 4) of the other view.

    Returns:
        [A b] (3, 4): pixel (x, y) at inverse depth w is at A (x, y, 1) + w b in the other view, homogeneous.
    """
    T = T_other_world @ inverse_se3(T_camera_world)
    K = other.matrix()
    return np.concatenate([K @ T[:3, :3] @ np.linalg.inv(camera.matrix()), (K @ T[:3, 3])[:, None]], axis=1)


def sub_sample_peak(left: NDArray, right: NDArray, curvature: NDArray) -> NDArray:
    """Offset (N,) of a parabola's peak from its middle sample, in samples and at most half of one.

    Args:
        left: Scores (N,) of the samples before the middle ones.
        right: Scores (N,) of the samples after them.
        curvature: 2 middle - left - right (N,), positive.
    """
    return np.clip((right - left) / (2.0 * curvature), -0.5, 0.5)


# Radius of the compared patches [px].
RADIUS = 3
SIDE = 2 * RADIUS + 1
PATCH = SIDE * SIDE
# Minimum contrast of a patch that can be matched: standard deviation of grey in [0, 1].
MIN_CONTRAST = 0.012
# Eight pixels per chunk, see `fields.runtime.compiled_kernel`.
SPREAD = HANDED_OUT // 8
# Score of a patch that leaves the image.
OUTSIDE = -2.0


@ti.data_oriented
class EpipolarDepth:
    """Depth by zero-mean normalised cross-correlation (ZNCC) over inverse depth, averaged over the neighbours.

    Patches are warped at constant depth, to first order, so that rotated and scaled views match. The evaluation of a
    sample stops early once the remaining neighbours cannot make it a match. The best sample is refined by a parabola.
    Matches that are weak, at an end of the range, or ambiguous are rejected. The deviation is computed from the
    sharpness of the peak and from `pixel_noise` in the neighbours.

    Args:
        settings: Settings of the search.
    """

    def __init__(self, settings: EpipolarSettings) -> None:
        self.settings = settings

    def estimate(self, view: Keyframe, neighbours: Sequence[Keyframe], pixels: NDArray[np.float64]) -> DepthEstimate:
        """See `DepthEstimator`. Searches the depth range of the view's tracked points, with a margin."""
        _, z = point_depths(view)
        chosen = self._choose(view, neighbours)
        if len(z) < 3 or not chosen or len(pixels) == 0:
            return unknown_depth(len(pixels))
        near, far = np.percentile(z, [2, 98]) * [1 / 1.5, 1.5]
        warps = np.stack(
            [plane_warp(view.camera, view.T_camera_world, k.camera, k.T_camera_world) for k in chosen]
        ).astype(np.float32)
        # One sample per pixel along the longest epipolar line.
        reach = max(np.linalg.norm(w[:2, 3]) for w in warps)
        samples = int(np.clip(np.ceil(reach * (1 / near - 1 / far)), 8, self.settings.max_samples))
        inverse = np.linspace(1 / far, 1 / near, samples)
        grey = _grey(view)
        height = max(k.rgba.shape[0] for k in chosen)
        width = max(k.rgba.shape[1] for k in chosen)
        others = np.zeros((len(chosen), height, width), dtype=np.float32)
        sizes = np.array([k.rgba.shape[1::-1] for k in chosen], dtype=np.int32)
        for image, k in zip(others, chosen, strict=True):
            image[: k.rgba.shape[0], : k.rgba.shape[1]] = _grey(k)
        images = (grey, others, sizes, warps, pixels.astype(np.float32), inverse.astype(np.float32))
        scores = np.empty((len(pixels), samples), dtype=np.float32)
        everywhere = np.zeros(len(pixels), dtype=np.int32)
        self._score(*images, everywhere, self.settings.min_score - self.settings.min_lead, scores)
        # Samples next to a peak may have been stopped early, but its shape depends on their exact scores.
        best = np.clip(scores.argmax(axis=1), 1, samples - 2)
        peak = np.empty((len(pixels), 3), dtype=np.float32)
        self._score(*images, (best - 1).astype(np.int32), OUTSIDE, peak)
        return self._peaks(scores, peak, inverse, reach)

    def _choose(self, view: Keyframe, neighbours: Sequence[Keyframe]) -> list[Keyframe]:
        """Neighbours with a similar viewing direction, by the closeness of their parallax to the preferred one."""
        T_world_view = inverse_se3(view.T_camera_world)
        rated = []
        for k in neighbours:
            T = k.T_camera_world @ T_world_view
            parallax = np.linalg.norm(T[:3, 3]) / view.median_depth
            if k.index != view.index and T[2, 2] > 0.8 and 0.01 < parallax < 0.5:
                rated.append((abs(np.log(parallax / self.settings.parallax)), k.index, k))
        return [k for _, _, k in sorted(rated, key=lambda r: r[:2])[: self.settings.views]]

    def _peaks(
        self, scores: NDArray[np.float32], peak: NDArray[np.float32], inverse: NDArray[np.float64], reach: np.floating
    ) -> DepthEstimate:
        """Depths at the peaks of `scores` (N, samples). `peak` (N, 3): exact scores around the best inner sample."""
        samples = len(inverse)
        best = scores.argmax(axis=1)
        inner = np.clip(best, 1, samples - 2)
        left, top, right = peak.T
        curvature = np.maximum(2 * top - left - right, 1e-6)
        offset = sub_sample_peak(left, right, curvature)
        away = np.abs(np.arange(samples)[None] - best[:, None]) > 2
        rival = np.where(away, scores, OUTSIDE).max(axis=1, initial=OUTSIDE)
        good = (
            (best == inner)
            & (left > OUTSIDE)
            & (right > OUTSIDE)
            & (top > self.settings.min_score)
            & (rival < top - self.settings.min_lead)
        )
        step = inverse[1] - inverse[0]
        at = inverse[inner] + offset * step
        # A noise of (1 - score) / 2 moves the peak of a parabola by sqrt((1 - score) / curvature) samples.
        spread = step * np.sqrt((1.01 - np.minimum(top, 1.0)) / curvature) + self.settings.pixel_noise / reach
        return DepthEstimate(1 / at, np.where(good, spread / at, np.inf))

    @ti.kernel
    def _score(
        self,
        grey: ti.types.ndarray(dtype=ti.f32, ndim=2),
        others: ti.types.ndarray(dtype=ti.f32, ndim=3),
        sizes: ti.types.ndarray(dtype=ti.i32, ndim=2),
        warps: ti.types.ndarray(dtype=ti.f32, ndim=3),
        pixels: ti.types.ndarray(dtype=ti.f32, ndim=2),
        inverse: ti.types.ndarray(dtype=ti.f32, ndim=1),
        first: ti.types.ndarray(dtype=ti.i32, ndim=1),
        floor: ti.f32,
        scores: ti.types.ndarray(dtype=ti.f32, ndim=2),
    ):
        """Scores of consecutive samples of each pixel, from its `first`; below `floor`, upper bounds of them."""
        if ti.static(on_gpu()):
            # One thread per sample, which recomputes the patch sums: a quarter more work for a hundred times the
            # threads.
            samples = scores.shape[1]
            for i in range(pixels.shape[0] * samples):
                n, s = i // samples, i % samples
                self._score_pixel(n, s, s + 1, grey, others, sizes, warps, pixels, inverse, first, floor, scores)
        else:
            for i in range(pixels.shape[0] * SPREAD):
                if i % SPREAD == 0:
                    n, end = i // SPREAD, scores.shape[1]
                    self._score_pixel(n, 0, end, grey, others, sizes, warps, pixels, inverse, first, floor, scores)

    @ti.func
    def _score_pixel(
        self,
        n,
        begin,
        end,
        grey: ti.template(),
        others: ti.template(),
        sizes: ti.template(),
        warps: ti.template(),
        pixels: ti.template(),
        inverse: ti.template(),
        first: ti.template(),
        floor,
        scores: ti.template(),
    ):
        # Replicating the border keeps patches at the edge usable.
        left, top = ti.cast(ti.floor(pixels[n, 0]), ti.i32) - RADIUS, ti.cast(ti.floor(pixels[n, 1]), ti.i32) - RADIUS
        right, bottom = grey.shape[1] - 1, grey.shape[0] - 1
        mean = 0.0
        for dy, dx in ti.ndrange(SIDE, SIDE):
            mean += grey[ti.min(ti.max(top + dy, 0), bottom), ti.min(ti.max(left + dx, 0), right)] / PATCH
        square = 0.0
        for dy, dx in ti.ndrange(SIDE, SIDE):
            value = grey[ti.min(ti.max(top + dy, 0), bottom), ti.min(ti.max(left + dx, 0), right)] - mean
            square += value * value
        textured = square > PATCH * MIN_CONTRAST * MIN_CONTRAST
        for place in range(begin, end):
            w = inverse[first[n] + place]
            total, seen = 0.0, 0
            bound = ti.select(textured, 1.0, OUTSIDE)
            for j in range(warps.shape[0]):
                if bound >= floor and textured:
                    score = self._correlate(n, j, w, left, top, mean, square, grey, others, sizes, warps, pixels)
                    if score > OUTSIDE:
                        total += score
                        seen += 1
                    # Upper bound on the mean score: the remaining neighbours score at most 1 each.
                    more = warps.shape[0] - 1 - j
                    bound = ti.select(seen + more > 0, (total + more) / ti.max(seen + more, 1), OUTSIDE)
            scores[n, place] = bound

    @ti.func
    def _correlate(
        self,
        n,
        j,
        w,
        left,
        top,
        mean,
        square,
        grey: ti.template(),
        others: ti.template(),
        sizes: ti.template(),
        warps: ti.template(),
        pixels: ti.template(),
    ):
        """ZNCC of a pixel's patch with neighbour j at inverse depth w; OUTSIDE if it leaves that image."""
        right, bottom = grey.shape[1] - 1, grey.shape[0] - 1
        q = ti.Vector([0.0, 0.0, 0.0])
        for c in ti.static(range(3)):
            q[c] = warps[j, c, 0] * pixels[n, 0] + warps[j, c, 1] * pixels[n, 1] + warps[j, c, 2] + w * warps[j, c, 3]
        x, y = q[0] / q[2], q[1] / q[2]
        # First-order warp of the patch. Over three pixels, the second-order term is thousandths of a pixel.
        xx, xy = (warps[j, 0, 0] - x * warps[j, 2, 0]) / q[2], (warps[j, 0, 1] - x * warps[j, 2, 1]) / q[2]
        yx, yy = (warps[j, 1, 0] - y * warps[j, 2, 0]) / q[2], (warps[j, 1, 1] - y * warps[j, 2, 1]) / q[2]
        x, y = x - 0.5, y - 0.5
        across, down = RADIUS * (ti.abs(xx) + ti.abs(xy)), RADIUS * (ti.abs(yx) + ti.abs(yy))
        inside = (q[2] > 0.0) & (x >= across) & (y >= down)
        inside = inside & (x + across < sizes[j, 0] - 1.0) & (y + down < sizes[j, 1] - 1.0)
        score = OUTSIDE
        if inside:
            sum_, square_, product = 0.0, 0.0, 0.0
            for dy, dx in ti.ndrange(SIDE, SIDE):
                here = grey[ti.min(ti.max(top + dy, 0), bottom), ti.min(ti.max(left + dx, 0), right)]
                px, py = x + (dx - RADIUS) * xx + (dy - RADIUS) * xy, y + (dx - RADIUS) * yx + (dy - RADIUS) * yy
                x0, y0 = ti.cast(px, ti.i32), ti.cast(py, ti.i32)
                u, v = px - x0, py - y0
                above = others[j, y0, x0] * (1.0 - u) + others[j, y0, x0 + 1] * u
                below = others[j, y0 + 1, x0] * (1.0 - u) + others[j, y0 + 1, x0 + 1] * u
                # Subtract the mean of the reference patch first. Sums of squares of the raw values would leave only
                # four digits of the variance, and the parabola of a flat peak would be determined by rounding.
                there = above * (1.0 - v) + below * v - mean
                sum_ += there
                square_ += there * there
                product += there * (here - mean)
            variance = ti.max(square_ - sum_ * sum_ / PATCH, 1e-8)
            score = product / ti.sqrt(variance * square)
        return score


def _grey(view: Keyframe) -> NDArray[np.float32]:
    return cv2.cvtColor(view.rgba[..., :3], cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0

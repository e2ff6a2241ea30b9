"""Depth by search along epipolar lines in posed neighbour keyframes."""

from collections.abc import Sequence

import cv2
import numpy as np
import taichi as ti
from numpy.typing import NDArray

from fields.backend import on_gpu
from fields.keyframes import Keyframe
from fields.parallel import HANDED_OUT
from fields.se3 import inverse_se3
from pipelines.depth.estimate import DepthEstimate, point_depths, unknown_depth
from pipelines.settings import EpipolarSettings

__all__ = ["EpipolarDepth"]

# Of the compared patches [px].
RADIUS = 3
SIDE = 2 * RADIUS + 1
PATCH = SIDE * SIDE
# A patch with less contrast (standard deviation of grey in [0, 1]) has nothing to match.
MIN_CONTRAST = 0.012
# A thread takes eight pixels at a time.
SPREAD = HANDED_OUT // 8
# Score where a patch leaves an image.
OUTSIDE = -2.0


@ti.data_oriented
class EpipolarDepth:
    """Zero-mean normalised cross correlation (ZNCC) over samples of inverse depth, averaged over the neighbours.

    A patch's pixels are carried over at one depth each, by rotation and translation, so that turned and scaled views
    match. The best sample is refined by a parabola; matches that are weak, at the end of the range, or nearly as
    good elsewhere are given up. The deviation follows from how sharp the peak is, in pixels of the neighbours.
    """

    def __init__(self, settings: EpipolarSettings) -> None:
        self.settings = settings

    def estimate(self, view: Keyframe, neighbours: Sequence[Keyframe], pixels: NDArray[np.float64]) -> DepthEstimate:
        """See `DepthEstimator`. The range searched is that of the view's tracked points, with a margin."""
        _, z = point_depths(view)
        chosen = self._choose(view, neighbours)
        if len(z) < 3 or not chosen or len(pixels) == 0:
            return unknown_depth(len(pixels))
        near, far = np.percentile(z, [2, 98]) * [1 / 1.5, 1.5]
        warps = np.stack([self._warp(view, other) for other in chosen]).astype(np.float32)
        # One sample a pixel along the longest epipolar line.
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
        scores = np.empty((len(pixels), samples), dtype=np.float32)
        self._score(grey, others, sizes, warps, pixels.astype(np.float32), inverse.astype(np.float32), scores)
        return self._peaks(scores, inverse, reach)

    def _choose(self, view: Keyframe, neighbours: Sequence[Keyframe]) -> list[Keyframe]:
        """The neighbours whose parallax is nearest to the wanted one, of those that look the same way."""
        T_world_view = inverse_se3(view.T_camera_world)
        rated = []
        for k in neighbours:
            T = k.T_camera_world @ T_world_view
            parallax = np.linalg.norm(T[:3, 3]) / view.median_depth
            if k.index != view.index and T[2, 2] > 0.8 and 0.01 < parallax < 0.5:
                rated.append((abs(np.log(parallax / self.settings.parallax)), k.index, k))
        return [k for _, _, k in sorted(rated, key=lambda r: r[:2])[: self.settings.views]]

    @staticmethod
    def _warp(view: Keyframe, other: Keyframe) -> NDArray[np.float64]:
        """(3, 4) [A b]: pixel (x, y) at inverse depth w is seen at A (x, y, 1) + w b, homogeneous, in `other`."""
        T = other.T_camera_world @ inverse_se3(view.T_camera_world)
        K, K_other = (np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1.0]]) for c in (view.camera, other.camera))
        return np.concatenate([K_other @ T[:3, :3] @ np.linalg.inv(K), (K_other @ T[:3, 3])[:, None]], axis=1)

    def _peaks(self, scores: NDArray[np.float32], inverse: NDArray[np.float64], reach: float) -> DepthEstimate:
        samples = len(inverse)
        rows = np.arange(len(scores))
        best = scores.argmax(axis=1)
        top = scores[rows, best]
        inner = np.clip(best, 1, samples - 2)
        left, right = scores[rows, inner - 1], scores[rows, inner + 1]
        curvature = np.maximum(2 * top - left - right, 1e-6)
        offset = np.clip((right - left) / (2 * curvature), -0.5, 0.5)
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
        # Half a height of noise (1 - score) moves the peak of a parabola by sqrt(noise / curvature) samples.
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
        scores: ti.types.ndarray(dtype=ti.f32, ndim=2),
    ):
        if ti.static(on_gpu()):
            # A thread a sample, which sums the patch anew: a quarter more work, in a hundred times as many threads.
            samples = inverse.shape[0]
            for i in range(pixels.shape[0] * samples):
                s = i % samples
                self._score_pixel(i // samples, s, s + 1, grey, others, sizes, warps, pixels, inverse, scores)
        else:
            for i in range(pixels.shape[0] * SPREAD):
                if i % SPREAD == 0:
                    n = i // SPREAD
                    self._score_pixel(n, 0, inverse.shape[0], grey, others, sizes, warps, pixels, inverse, scores)

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
        scores: ti.template(),
    ):
        # Replicating the border keeps patches at the edge usable.
        left, top = ti.cast(ti.floor(pixels[n, 0]), ti.i32) - RADIUS, ti.cast(ti.floor(pixels[n, 1]), ti.i32) - RADIUS
        right, bottom = grey.shape[1] - 1, grey.shape[0] - 1
        mean, square = 0.0, 0.0
        for dy, dx in ti.ndrange(SIDE, SIDE):
            value = grey[ti.min(ti.max(top + dy, 0), bottom), ti.min(ti.max(left + dx, 0), right)]
            mean += value / PATCH
            square += value * value
        square -= PATCH * mean * mean
        for s in range(begin, end):
            total, seen = 0.0, 0
            if square > PATCH * MIN_CONTRAST * MIN_CONTRAST:
                for j in range(warps.shape[0]):
                    inside = 1
                    sum_, square_, product = 0.0, 0.0, 0.0
                    for dy, dx in ti.ndrange(SIDE, SIDE):
                        here = grey[ti.min(ti.max(top + dy, 0), bottom), ti.min(ti.max(left + dx, 0), right)]
                        px, py = pixels[n, 0] + (dx - RADIUS), pixels[n, 1] + (dy - RADIUS)
                        q = ti.Vector([0.0, 0.0, 0.0])
                        for c in ti.static(range(3)):
                            q[c] = (
                                warps[j, c, 0] * px + warps[j, c, 1] * py + warps[j, c, 2] + inverse[s] * warps[j, c, 3]
                            )
                        x, y = q[0] / q[2] - 0.5, q[1] / q[2] - 0.5
                        ok = (q[2] > 0.0) & (x >= 0.0) & (y >= 0.0)
                        ok = ok & (x < sizes[j, 0] - 1.0) & (y < sizes[j, 1] - 1.0)
                        inside = ti.select(ok, inside, 0)
                        x0, y0 = ti.select(ok, ti.cast(x, ti.i32), 0), ti.select(ok, ti.cast(y, ti.i32), 0)
                        u, v = x - x0, y - y0
                        above = others[j, y0, x0] * (1.0 - u) + others[j, y0, x0 + 1] * u
                        below = others[j, y0 + 1, x0] * (1.0 - u) + others[j, y0 + 1, x0 + 1] * u
                        there = above * (1.0 - v) + below * v
                        sum_ += there
                        square_ += there * there
                        product += there * (here - mean)
                    if inside == 1:
                        variance = ti.max(square_ - sum_ * sum_ / PATCH, 1e-8)
                        total += product / ti.sqrt(variance * square)
                        seen += 1
            scores[n, s] = ti.select(seen > 0, total / ti.max(seen, 1), OUTSIDE)


def _grey(view: Keyframe) -> NDArray[np.float32]:
    return cv2.cvtColor(view.rgba[..., :3], cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0

"""Densification: positions and initial values of new Gaussians (Section 3.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from fields.map.gaussians import NO_ANCHOR, SH_C0, GaussianField
from fields.map.keyframe import Keyframe
from fields.voxels.occupancy import OccupancyVoxels
from pipelines.companions.exposure import scene_colours
from pipelines.densify.depth.estimate import DepthEstimate, misplacement
from pipelines.safeguards import MemoryBudget
from pipelines.settings import DensifySettings

# Deviation of log depth from which a depth contains no information.
UNKNOWN = 0.5
# A pixel whose rendered opacity is below this counts as a hole.
HOLE = 0.5


@dataclass(frozen=True)
class Seeds:
    """Positions and colours of new Gaussians.

    Attributes:
        xyz: Positions (N, 3) in the world frame.
        size: Width (N,) of a pixel at the depth of each seed, d / f of Eq. 1 [scene units].
        colour: Scene colours (N, 3) [1 = white]; clipped to [0, 2] under an exposure or vignette.
    """

    xyz: NDArray[np.float64]
    size: NDArray[np.float64]
    colour: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.size)

    def __getitem__(self, keep: NDArray | slice) -> Seeds:
        return Seeds(self.xyz[keep], self.size[keep], self.colour[keep])


def _at_pixels(view: Keyframe, pixels: NDArray[np.float64], xyz: NDArray, depth: NDArray) -> Seeds:
    """Seeds at pixels (N, 2) of a view, except those on masked pixels. Their size is d / f of Eq. 1."""
    places = np.floor(pixels).astype(int)
    valid = view.rgba[places[:, 1], places[:, 0], 3] > 0
    return Seeds(xyz, depth / view.camera.focal, scene_colours(view, places))[valid]


def tracked_seeds(view: Keyframe) -> Seeds:
    """Seeds at the tracked points in the view's image: geometry and texture complex regions (P_i of Section 3.2.2)."""
    depth = view.points.depths(view.T_camera_world)
    keep = (depth > 0) & view.camera.contains(view.points.pixels)
    return _at_pixels(view, view.points.pixels[keep], view.points.xyz[keep], depth[keep])


def dissimilarity(render: NDArray[np.floating], rgba: NDArray[np.uint8]) -> NDArray[np.float32]:
    """1 - SSIM in grey (H, W) between a render (H, W, 3) and an image (H, W, 4), after a slight blur against noise.

    It is 0 at masked pixels.
    """

    def smooth(image: NDArray, side: int, sigma: float) -> NDArray[np.float32]:
        return np.asarray(cv2.GaussianBlur(image, (side, side), sigma), dtype=np.float32)

    a = smooth(cv2.cvtColor(np.clip(render, 0, 1).astype(np.float32), cv2.COLOR_RGB2GRAY), 5, 0.5)
    b = smooth(cv2.cvtColor(rgba[..., :3], cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0, 5, 0.5)
    mu_a, mu_b = smooth(a, 11, 1.5), smooth(b, 11, 1.5)
    var_a, var_b = smooth(a * a, 11, 1.5) - mu_a**2, smooth(b * b, 11, 1.5) - mu_b**2
    covariance = smooth(a * b, 11, 1.5) - mu_a * mu_b
    c1, c2 = 0.01**2, 0.03**2
    ssim = (2 * mu_a * mu_b + c1) * (2 * covariance + c2) / ((mu_a**2 + mu_b**2 + c1) * (var_a + var_b + c2))
    return np.where(rgba[..., 3] > 0, 1.0 - ssim, 0.0).astype(np.float32)


def error_pixels(
    view: Keyframe,
    error: NDArray[np.float32] | None,
    settings: DensifySettings,
    rng: np.random.Generator,
    share: float = 1.0,
) -> NDArray[np.float64]:
    """Sample pixels of high error regions: 1 - SSIM is high, and there is no tracked point (Section 3.2.2).

    The more of the image is wrong, the more pixels are sampled: where the camera moves far between two keyframes, most
    of an image is new to the map.

    Args:
        view: The view to sample.
        error: 1 - SSIM (H, W) of the map's render; None samples from all valid pixels, as in the warm-up.
        settings: Threshold and number of pixels.
        rng: Random generator.
        share: Share of the settings' number of pixels.

    Returns:
        Pixel centres (N, 2) as (x, y).
    """
    height, width = view.rgba.shape[:2]
    candidate = view.rgba[..., 3] > 0
    if error is not None:
        candidate &= error >= settings.dissimilarity
    inside = view.points.pixels[view.camera.contains(view.points.pixels)].astype(int)
    candidate[inside[:, 1], inside[:, 0]] = False
    places = np.flatnonzero(candidate)
    candidates = 0.0 if error is None else len(places) / (width * height)
    count = min(round(share * settings.pixels_of(width, height, candidates)), len(places))
    chosen = np.sort(rng.choice(places, count, replace=False))
    return np.stack([chosen % width + 0.5, chosen // width + 0.5], axis=1)


def seeds_at(view: Keyframe, pixels: NDArray[np.float64], depth: NDArray[np.float64]) -> Seeds:
    """Seeds at pixels (N, 2) of a view with these depths (N,), except those on masked pixels."""
    T_world_camera = inverse_se3(view.T_camera_world)
    xyz = view.camera.unproject(pixels, depth) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    return _at_pixels(view, pixels, xyz, depth)


def pixel_seeds(
    view: Keyframe,
    neighbours: Sequence[Keyframe],
    pixels: NDArray[np.float64],
    estimate: DepthEstimate,
    max_deviation: float | NDArray[np.float64],
    max_misplacement: float = 0.0,
) -> Seeds:
    """Seeds at the pixels whose depth is certain, or whose uncertainty the neighbours would hardly see.

    Args:
        view: The view of the pixels.
        neighbours: Other keyframes.
        pixels: Pixels (N, 2) as (x, y).
        estimate: Their depths.
        max_deviation: Standard deviation of log depth, a scalar or (N,), below which the depth is certain.
        max_misplacement: Misplacement below which an uncertain depth is used all the same, see `misplacement` [px].
    """
    sure = estimate.deviation < max_deviation
    if max_misplacement > 0:
        unsure = np.flatnonzero(~sure & (estimate.deviation < UNKNOWN))
        moved = misplacement(view, neighbours, pixels[unsure], estimate.depth[unsure], estimate.deviation[unsure])
        sure[unsure[moved < max_misplacement]] = True
    return seeds_at(view, pixels[sure], estimate.depth[sure])


def grow(
    gaussians: GaussianField,
    seeds: Seeds,
    voxels: OccupancyVoxels | None,
    target: float,
    settings: DensifySettings,
    budget: MemoryBudget,
    anchor: int = NO_ANCHOR,
) -> int:
    """Add isotropic Gaussians at the seeds that the voxels admit.

    If the budget has no room for all seeds, only the first ones are added.

    Args:
        gaussians: The map.
        seeds: Candidates for new Gaussians.
        voxels: Occupancy voxels; None adds every seed.
        target: Target voxel size [scene units].
        settings: Initial scale and opacity.
        budget: Memory budget of the map.
        anchor: Anchor of the new Gaussians, see `GaussianField`.

    Returns:
        Number of Gaussians added.
    """
    if budget.may_cut(len(seeds)):
        # Cut to the budget before marking: a cell that is marked but empty would reject all later Gaussians.
        if voxels is not None:
            seeds = seeds[~voxels.query(seeds.xyz, target)]
        seeds = seeds[: budget.take_gaussians(seeds.xyz, target)]
    if voxels is not None:
        seeds = seeds[voxels.admit(seeds.xyz, target)]
    n = len(seeds)
    log_scale = np.log(settings.initial_scale * seeds.size) + settings.scale_offset
    sh = np.zeros((n, gaussians.sh_count, 3))
    sh[:, 0] = (seeds.colour - 0.5) / SH_C0
    gaussians.append(
        position=seeds.xyz,
        log_scale=np.repeat(log_scale[:, None], 3, axis=1),
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        opacity_logit=np.full(n, np.log(settings.initial_opacity / (1.0 - settings.initial_opacity))),
        sh=sh,
        anchor=anchor,
    )
    return n

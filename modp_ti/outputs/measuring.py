"""Points on the surface of a finished map, and lengths and areas between them, with their deviations."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3, matrices_from_unit_quaternions
from modp_ti.files import read_json
from modp_ti.files.errors import InputError
from modp_ti.outputs.playback.finished_run import FinishedRun
from pipelines.render.formulas import ALPHA_MIN, BLUR

# The file of an output folder that says in what units and axes its world is.
WORLD = "world.json"
# Opacity along a ray from which on there is a surface.
SOLID = 0.5
# Standard deviations of a Gaussian around its mean in which a ray meets it.
REACH = 3.5


@dataclass(frozen=True)
class SurfacePoint:
    """A point on the surface of a map.

    Attributes:
        xyz: Position (3,) [scene units].
        covariance: Its covariance (3, 3): the spread of depth along the ray, and half a pixel across it.
    """

    xyz: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @property
    def deviation(self) -> float:
        """Standard deviation of the position along its most uncertain direction [scene units]."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))


def surface_point(
    gaussians: Mapping[str, NDArray], origin: NDArray[np.float64], ray: NDArray[np.float64], pixel: float
) -> SurfacePoint | None:
    """Return where a ray meets the surface of a map.

    The depth is the median along the ray, by the weights with which the Gaussians are composited. Unlike the first
    Gaussian's depth or the mean, it is neither drawn to the camera by floating Gaussians nor off an edge of depth.

    Args:
        gaussians: Arrays by name, as from `GaussianField.to_numpy`.
        origin: Start (3,) of the ray [scene units].
        ray: Direction (3,) of the ray, of any length.
        pixel: Angle of a pixel of the picture in which the point was chosen [rad].

    Returns:
        The point; None if the map's opacity along the ray is below `SOLID`.
    """
    d = np.asarray(ray, dtype=np.float64) / np.linalg.norm(ray)
    v = gaussians["position"].astype(np.float64) - origin
    along = v @ d
    largest = np.exp(gaussians["log_scale"].max(axis=1).astype(np.float64))
    off = np.sqrt(np.maximum((v * v).sum(axis=1) - along**2, 0.0))
    met = np.flatnonzero((along > 0) & (off < REACH * (largest + pixel * along)))
    v, along = v[met], along[met]
    q = gaussians["quaternion"][met].astype(np.float64)
    R = matrices_from_unit_quaternions(q / np.linalg.norm(q, axis=1, keepdims=True))
    M = R * np.exp(gaussians["log_scale"][met].astype(np.float64))[:, None, :]
    # Covariances in axes across the ray and along it. As in the renderer, a pixel's footprint is added across the ray,
    # and opacities are compensated for it.
    across = np.linalg.svd(d[None])[2][1:]
    M = np.vstack([across, d[None]]) @ M
    covariance = M @ M.transpose(0, 2, 1)
    S = covariance[:, :2, :2] + np.eye(2) * (BLUR * (pixel * along) ** 2)[:, None, None]
    solved = np.linalg.solve(S, np.concatenate([(-v @ across.T)[..., None], covariance[:, :2, 2:]], axis=2))
    x, slope = solved[..., 0], solved[..., 1]
    compensation = np.sqrt(np.maximum(np.linalg.det(covariance[:, :2, :2]) / np.linalg.det(S), 0.0))
    opacity = compensation / (1.0 + np.exp(-gaussians["opacity_logit"][met].astype(np.float64)))
    alpha = np.minimum(opacity * np.exp(0.5 * (v @ across.T * x).sum(axis=1)), 0.99)
    depth = along + (covariance[:, :2, 2] * x).sum(axis=1)  # of each Gaussian's peak along the ray
    own = np.maximum(covariance[:, 2, 2] - (covariance[:, :2, 2] * slope).sum(axis=1), 0.0)  # its variance there
    order = np.argsort(depth, kind="stable")
    order = order[alpha[order] >= ALPHA_MIN]
    transmittance = np.cumprod(np.concatenate([[1.0], 1.0 - alpha[order]]))
    weight = alpha[order] * transmittance[:-1]
    if weight.sum() < SOLID:
        return None
    share = np.cumsum(weight) / weight.sum()
    near, middle, far = order[np.searchsorted(share, [0.16, 0.5, 0.84])]
    z = depth[middle]
    spread = (0.5 * (depth[far] - depth[near])) ** 2 + own[middle]
    side = (0.5 * pixel * z) ** 2
    return SurfacePoint(origin + z * d, side * np.eye(3) + (spread - side) * np.outer(d, d))


def point_at(run: FinishedRun, text: str) -> SurfacePoint:
    """Return the point of a finished map at a pixel of a frame, written as "x,y@frame", with the frame's number.

    Raises:
        InputError: If it is not written so, the run has no such pixel, or the map has no surface there.
    """
    number = r"(\d+(?:\.\d*)?)"
    match = re.fullmatch(rf"{number},{number}@(\d+)", text)
    if match is None:
        raise InputError(f"{text}: a point is written X,Y@FRAME, such as 120,80@40")
    pixel, frame = np.array([[float(match[1]), float(match[2])]]), int(match[3])
    if frame >= len(run):
        raise InputError(f"{text}: the run has frames 0 to {len(run) - 1}")
    camera, T_world_camera = run.cameras[frame], inverse_se3(run.poses[frame])
    if not camera.contains(pixel)[0]:
        raise InputError(f"{text}: frame {frame} was mapped with {camera.width}x{camera.height} pixels")
    ray = T_world_camera[:3, :3] @ camera.unproject(pixel, np.ones(1))[0]
    point = surface_point(run.gaussians, T_world_camera[:3, 3], ray, 1.0 / camera.focal)
    if point is None:
        raise InputError(f"{text}: the map has no surface there; choose another pixel")
    return point


def length(points: Sequence[SurfacePoint]) -> tuple[float, float]:
    """Return the length of a polyline through two points or more, and its standard deviation [scene units]."""
    xyz = np.stack([point.xyz for point in points])
    steps = np.diff(xyz, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    units = steps / np.maximum(lengths, 1e-300)[:, None]
    slopes = np.zeros_like(xyz)
    slopes[1:] += units
    slopes[:-1] -= units
    return float(lengths.sum()), _deviation(slopes, points)


def area(points: Sequence[SurfacePoint]) -> tuple[float, float]:
    """Return the area of a polygon of three points or more, projected to its own plane, and its deviation."""
    xyz = np.stack([point.xyz for point in points])
    centred = xyz - xyz.mean(axis=0)
    vector = 0.5 * np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
    size = float(np.linalg.norm(vector))
    normal = vector / max(size, 1e-300)
    slopes = 0.5 * np.cross(np.roll(xyz, -1, axis=0) - np.roll(xyz, 1, axis=0), normal)
    return size, _deviation(np.asarray(slopes, dtype=np.float64), points)


def _deviation(slopes: NDArray[np.float64], points: Sequence[SurfacePoint]) -> float:
    """Deviation of a number with derivatives (N, 3) with respect to N independent points."""
    return float(np.sqrt(sum(g @ point.covariance @ g for g, point in zip(slopes, points, strict=True))))


def read_world(folder: Path) -> dict[str, Any]:
    """Return what an output folder says of the units and axes of its world; nothing if it was never scaled."""
    path = folder / WORLD
    return read_json(path, "of a finished run") if path.is_file() else {}


@dataclass(frozen=True)
class Ruler:
    """Finds points of a map, and says what they span.

    Attributes:
        gaussians: Arrays by name, as from `GaussianField.to_numpy`.
        unit: Name of the map's unit.
        deviation: Relative standard deviation of the map's scale.
    """

    gaussians: Mapping[str, NDArray]
    unit: str = "scene units"
    deviation: float = 0.0

    @classmethod
    def of(cls, run: FinishedRun) -> Ruler:
        """Return the ruler of a finished run, in metres where it has been scaled (`modp-ti scale`)."""
        world = read_world(run.folder)
        return cls(run.gaussians, world.get("unit", cls.unit), world.get("deviation", 0.0))

    def point(self, origin: NDArray[np.float64], ray: NDArray[np.float64], pixel: float) -> SurfacePoint | None:
        """See `surface_point`."""
        return surface_point(self.gaussians, origin, ray, pixel)

    def spans(self, points: Sequence[SurfacePoint]) -> dict[str, tuple[float, float]]:
        """Return the length of two points or more, and the area of three or more, each with its deviation."""
        found = {"length": length(points)} if len(points) > 1 else {}
        found |= {"area": area(points)} if len(points) > 2 else {}
        # An area's relative deviation is twice that of the scale.
        return {
            name: (value, float(np.hypot(spread, (1 + (name == "area")) * self.deviation * value)))
            for name, (value, spread) in found.items()
        }

    def text(self, points: Sequence[SurfacePoint]) -> str:
        """Return `spans` in words; empty for fewer than two points."""
        squared = {"length": "", "area": "\u00b2"}
        return ", ".join(
            f"{name} {value:.4g} \u00b1 {spread:.2g} {self.unit}{squared[name]}"
            for name, (value, spread) in self.spans(points).items()
        )

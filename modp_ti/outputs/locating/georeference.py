"""The place of a map on the Earth, by GPS positions of its cameras: a robust similarity to local metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import camera_centres
from modp_ti.files.errors import InputError
from modp_ti.inputs.positions import Positions
from modp_ti.outputs.evaluation import umeyama
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.splat_page.page import Y, levelled, turning

# The ellipsoid of WGS84: equatorial radius [m], and squared eccentricity.
RADIUS, ECCENTRICITY = 6_378_137.0, 6.69437999014e-3
# Frames between which a camera's place is interpolated [s].
GAP = 2.0
# Rounds of reweighting. Errors count fully up to REACH deviations, which begins WIDE times as large and halves.
ROUNDS, REACH, WIDE = 20, 3.0, 64.0
# Baselines longer than the error that must be there.
BASELINES = 3
# Without a known vertical, it is estimated if the cameras' places spread by so many errors in two directions.
SPREAD = 5.0


@dataclass(frozen=True)
class GeoReference:
    """A similarity from a map to metres with x east, y down and z north of an origin: s R x + t.

    Attributes:
        s: Metres per scene unit.
        R: Rotation (3, 3).
        t: Translation (3,) [m].
        deviation: Relative standard deviation of the scale, and that of the heading [rad].
        origin: Latitude [degrees], longitude [degrees] and height [m] of the origin.
        place: Standard deviation of the origin in one direction [m].
        error: Robust standard deviation of the positions in one direction [m].
        count: Number of positions.
    """

    s: float
    R: NDArray[np.float64]
    t: NDArray[np.float64]
    deviation: float
    origin: NDArray[np.float64]
    place: float
    error: float
    count: int

    @property
    def text(self) -> str:
        """The scale and the place in words."""
        place = "{:.7f}, {:.7f}, {:.1f} m".format(*self.origin)
        return (
            f"{self.s:.6g} m per unit by {self.count} GPS positions with errors of {self.error:.2g} m, \u00b1 "
            f"{100 * self.deviation:.2g} %; origin {place}"
        )

    @property
    def about(self) -> dict[str, Any]:
        """What `world.json` says of the new world."""
        return {
            "unit": "m",
            "deviation": self.deviation,
            "by": f"{self.count} GPS positions",
            "down": Y.tolist(),
            "axes": "x east, y down, z north",
            "origin": dict(zip(("latitude", "longitude", "height"), self.origin.tolist(), strict=True)),
            "origin_deviation": self.place,
            "heading_deviation": float(np.degrees(self.deviation)),
        }


def ecef(geodetic: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert latitude [degrees], longitude [degrees] and height [m] (..., 3) to Earth-centred coordinates (..., 3)."""
    latitude, longitude = np.radians(geodetic[..., 0]), np.radians(geodetic[..., 1])
    height = geodetic[..., 2]
    normal = RADIUS / np.sqrt(1.0 - ECCENTRICITY * np.sin(latitude) ** 2)
    across = (normal + height) * np.cos(latitude)
    along = ((1.0 - ECCENTRICITY) * normal + height) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), along], axis=-1)


def axes_at(origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the Earth-centred unit vectors of east, down and north as columns (3, 3), at geodetic coordinates (3,)."""
    (a, b), (c, d) = np.sin(np.radians(origin[:2])), np.cos(np.radians(origin[:2]))
    return np.array([[-b, -c * d, -a * d], [d, -c * b, -a * b], [0.0, -a, c]])


def georeference(run: FinishedRun, positions: Positions, down: NDArray[np.float64] | None) -> GeoReference:
    """Estimate where a finished map lies.

    Args:
        run: The finished run.
        positions: Positions of its cameras.
        down: The map's vertical (3,) where it is known better than by positions; None: it is estimated, or if the
            cameras went in a line, taken from how they were held.

    Raises:
        InputError: If too few positions are of the run's frames, or they do not tell the scale.
    """
    centres, geodetic = _centres_at(run, positions)
    if len(centres) <= BASELINES:
        spans = [f"{t[0]:.1f} to {t[-1]:.1f} s" for t in (run.timestamps, positions.times) if t is not None]
        clocks = f", of {spans[0]}; the positions are of {spans[1]} (--gps-offset)" if len(spans) > 1 else ""
        raise InputError(f"{run.folder}: only {len(centres)} GPS positions are of its frames{clocks}")
    origin = np.median(geodetic, axis=0)
    target = (ecef(geodetic) - ecef(origin)) @ axes_at(origin)
    s, R, t, error, weight = robust_similarity(centres, target, down)
    if down is None:
        share = np.linalg.svd((centres - centres.mean(axis=0)) * s / np.sqrt(len(centres)))[1]
        if share[1] < SPREAD * error:
            s, R, t, error, weight = robust_similarity(centres, target, levelled(run).R[1])
    if _baselines(s * centres, error) < BASELINES:
        raise InputError(
            f"{run.folder}: its {len(centres)} GPS positions do not tell the scale: it takes {BASELINES} ways between "
            f"frames that are longer than their error ({error:.2g} m); give a length instead (--from, --to, --metres)"
        )
    residual = target - s * centres @ R.T - t
    near = weight > 0.5
    spread = s * np.sqrt(((centres[near] - centres[near].mean(axis=0)) ** 2).mean(axis=0).sum())
    place = float(error * np.sqrt(_together(residual[near]) / near.sum()))
    return GeoReference(s, R, t, float(place / spread), origin, place, error, len(centres))


def _centres_at(run: FinishedRun, positions: Positions) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the camera centres (M, 3) of the run at positions, and the geodetic coordinates (M, 3) of these."""
    centres, geodetic = camera_centres(run.poses), positions.geodetic
    if positions.times is None:
        place = {name: k for k, name in enumerate(run.names)}
        which = [k for k, name in enumerate(positions.names or ()) if name in place]
        centres, geodetic = centres[[place[(positions.names or ())[k]] for k in which]], geodetic[which]
    else:
        times = run.timestamps[run.way]
        gap = np.diff(times, append=np.inf)[np.searchsorted(times, positions.times, side="right") - 1]
        at = positions.times[gap < GAP]
        centres = np.stack([np.interp(at, times, axis) for axis in centres[run.way].T], axis=1)
        geodetic = geodetic[gap < GAP]
    known = np.isfinite(geodetic).all(axis=1)
    return centres[known], geodetic[known]


def robust_similarity(
    source: NDArray[np.float64], target: NDArray[np.float64], down: NDArray[np.float64] | None
) -> tuple[float, NDArray[np.float64], NDArray[np.float64], float, NDArray[np.float64]]:
    """Fit s R source + t to a target with outliers.

    The weights are those of Geman and McClure, with a width that begins large and ends at `REACH` deviations.

    Args:
        source: Points (N, 3).
        target: Corresponding points (N, 3), y down.
        down: Direction (3,) that R takes to y; None if it is free.

    Returns:
        Scale s, rotation R (3, 3), translation t (3,), the deviation in one direction, and the weights (N,).
    """
    weight, error = np.ones(len(source)), 0.0
    s, R, t = 1.0, np.eye(3), np.zeros(3)
    for step in range(ROUNDS):
        s, R, t = umeyama(source, target, weight=weight) if down is None else _level(source, target, down, weight)
        size = np.linalg.norm(target - s * source @ R.T - t, axis=1)
        error = float(np.median(size)) / 1.5382  # the median of the length of a vector with unit deviations
        weight = 1.0 / (1.0 + (size / (REACH * max(error, 1e-12) * max(WIDE / 2**step, 1.0))) ** 2) ** 2
    return s, R, t, error, weight


def _level(
    source: NDArray[np.float64], target: NDArray[np.float64], down: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """The similarity of least squares among those that take `down` to y."""
    R = turning(down, Y)
    middles = [np.average(points, axis=0, weights=weight) for points in (source, target)]
    a, b = (source - middles[0]) @ R.T, target - middles[1]
    product = (weight * (a[:, 0] - 1j * a[:, 2]) * (b[:, 0] + 1j * b[:, 2])).sum()
    c, d = product.real / abs(product), product.imag / abs(product)  # of the angle from x towards z
    s = (abs(product) + (weight * a[:, 1] * b[:, 1]).sum()) / (weight * (a * a).sum(axis=1)).sum()
    R = np.array([[c, 0.0, -d], [0.0, 1.0, 0.0], [d, 0.0, c]]) @ R
    return float(s), R, middles[1] - s * R @ middles[0]


def _baselines(places: NDArray[np.float64], error: float) -> int:
    """Return how often the camera went farther than an error."""
    count, last = 0, places[0]
    for place in places:
        if np.linalg.norm(place - last) > error:
            count, last = count + 1, place
    return count


def _together(residual: NDArray[np.float64]) -> float:
    """Return how many positions share one error, since those of GPS drift, from their correlation with the next."""
    r = residual - residual.mean(axis=0)
    correlation = np.clip((r[1:] * r[:-1]).sum() / max((r * r).sum(), 1e-300), 0.0, 0.999)
    return float((1.0 + correlation) / (1.0 - correlation))

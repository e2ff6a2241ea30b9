"""Lens distortion of the COLMAP and transforms.json camera models, forward and inverse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from modp_ti.files.errors import InputError

Points = NDArray[np.float64]

TABLE_SIZE = 4096
# Newton's method ends for a point whose error in distorted coordinates is smaller. Rounding is some 1e-16.
CONVERGED = 1e-14
# Names of two lens models.
PLUMB_BOB, EQUIDISTANT = ("plumb_bob", "radial-tangential", "radtan"), ("equidistant", "equi", "fisheye")


@dataclass(frozen=True)
class Distortion:
    """Lens distortion, a map from ideal pinhole coordinates (x / z, y / z) to distorted ones.

    With r^2 = x^2 + y^2, the radial part multiplies (x, y) by

        perspective  (1 + n1 r^2 + n2 r^4 + ...) / (1 + d1 r^2 + d2 r^4 + ...)
        fisheye      theta (1 + n1 theta^2 + n2 theta^4 + ...) / r,   theta = atan(r)
        fov          atan(2 r tan(fov / 2)) / (r fov)

    and the tangential part (p1, p2) adds (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y). The conventions
    are those of OpenCV. A thin prism (s1, s2, s3, s4) adds (s1 r^2 + s2 r^4, s3 r^2 + s4 r^4). Of a fisheye lens, the
    tangential part and the prism are of (x, y) theta / r, or of the radially distorted (x, y) with `radial_first`.

    Attributes:
        numerator: Coefficients n1, n2, ...
        denominator: Coefficients d1, d2, ... Not used for fisheye lenses.
        tangential: Coefficients (p1, p2).
        fisheye: Whether the radial part is the fisheye model.
        prism: Coefficients (s1, s2, s3, s4) of a thin prism.
        radial_first: What the tangential part and the prism of a fisheye lens are of.
        fov: Angle of the FOV model [rad]; 0 for the other models.
    """

    numerator: tuple[float, ...] = ()
    denominator: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    fisheye: bool = False
    prism: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    radial_first: bool = False
    fov: float = 0.0

    @property
    def is_identity(self) -> bool:
        coefficients = (*self.numerator, *self.denominator, *self.tangential, *self.prism)
        return not (self.fisheye or self.fov or any(coefficients))

    def distort(self, points: Points) -> Points:
        """Map ideal coordinates (..., 2) to distorted ones (..., 2)."""
        x, y = points[..., 0], points[..., 1]
        r2 = x * x + y * y
        factor = self._radial_factor(np.sqrt(r2))
        p1, p2 = self.tangential
        radial = x * factor, y * factor
        if self.fisheye:
            shrunk = factor if self.radial_first else Distortion(fisheye=True)._radial_factor(np.sqrt(r2))
            x, y = x * shrunk, y * shrunk
            r2 = x * x + y * y
        distorted = [
            radial[0] + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            radial[1] + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ]
        if any(self.prism):
            s1, s2, s3, s4 = self.prism
            distorted = [distorted[0] + (s1 + s2 * r2) * r2, distorted[1] + (s3 + s4 * r2) * r2]
        return np.stack(distorted, axis=-1)

    def _radial_factor(self, r: NDArray[np.floating]) -> NDArray[np.floating]:
        if self.fisheye:
            theta = np.arctan(r)
            ratio = np.divide(theta, r, out=np.ones_like(r), where=r > 1e-12)
            return ratio * polynomial.polyval(theta * theta, (1.0, *self.numerator))
        if self.fov:
            return np.divide(
                np.arctan(2.0 * r * np.tan(0.5 * self.fov)), r * self.fov, out=np.ones_like(r), where=r > 1e-12
            )
        r2 = r * r
        return polynomial.polyval(r2, (1.0, *self.numerator)) / polynomial.polyval(r2, (1.0, *self.denominator))

    def valid_radius(self, limit: float) -> float:
        """Return the ideal radius up to which the distorted radius increases, at most `limit`.

        Beyond it the polynomial folds back: two rays would project to one pixel, and only the inner one is real.
        """
        r, distorted = self._radial_table(limit)
        falling = np.flatnonzero(np.diff(distorted) <= 0)
        return float(r[falling[0]]) if len(falling) else limit

    def _radial_table(self, limit: float) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        r = np.linspace(0.0, limit, TABLE_SIZE)
        return r, r * self._radial_factor(r)

    def undistort(self, points: Points, limit: float) -> Points:
        """Map distorted coordinates to ideal ones, by Newton's method starting from the inverse of the radial part.

        Args:
            points: Distorted coordinates (N, 2).
            limit: Largest ideal radius to search.

        Returns:
            Ideal coordinates (N, 2); NaN if there is no solution within the valid radius.
        """
        points = np.asarray(points, dtype=np.float64)
        if self.is_identity or len(points) == 0:
            return points.copy()
        valid = self.valid_radius(limit)
        r, distorted = self._radial_table(valid)
        radius = np.linalg.norm(points, axis=1)
        ratio = np.divide(np.interp(radius, distorted, r), radius, out=np.ones_like(radius), where=radius > 1e-12)
        ideal = points * ratio[:, None]
        going = np.arange(len(points))  # points that have not converged
        for _ in range(8):
            residual = self.distort(ideal[going]) - points[going]
            more = np.abs(residual).max(axis=1) > CONVERGED
            going, residual = going[more], residual[more]
            if len(going) == 0:
                break
            ideal[going] -= np.linalg.solve(self._jacobian(ideal[going]), residual[..., None])[..., 0]
        error = np.abs(self.distort(ideal) - points).max(axis=1)
        found = (error < 1e-9) & (np.linalg.norm(ideal, axis=1) <= valid)
        return np.where(found[:, None], ideal, np.nan)

    def _jacobian(self, points: Points) -> NDArray[np.float64]:
        """Compute Jacobians (N, 2, 2) by central differences, which are accurate enough for Newton's method."""
        step = 1e-6
        dx, dy = np.array([step, 0.0]), np.array([0.0, step])
        columns = [(self.distort(points + d) - self.distort(points - d)) / (2 * step) for d in (dx, dy)]
        jacobian = np.stack(columns, axis=-1)
        singular = ~np.isfinite(jacobian).all(axis=(1, 2)) | (np.abs(np.linalg.det(jacobian)) < 1e-9)
        jacobian[singular] = np.eye(2)  # these points fail the final check in `undistort`
        return jacobian


NO_DISTORTION = Distortion()

COEFFICIENTS = {
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "SIMPLE_RADIAL_FISHEYE": ("k1",),
    "RADIAL_FISHEYE": ("k1", "k2"),
    "THIN_PRISM_FISHEYE": ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3"),
    "FOV": ("omega",),
}
"""Names of the coefficients of some of COLMAP's camera models, in its order."""


def lens_of_model(model: str, D: Sequence[float], where: str) -> Distortion:  # as in OpenCV
    """Return the lens of a model that ROS, Kalibr or EuRoC names, with coefficients in OpenCV's order.

    Raises:
        InputError: If the model is not supported. `where` starts its message.
    """
    if not np.any(D):
        return Distortion(fisheye=True) if model in EQUIDISTANT else NO_DISTORTION
    if model in PLUMB_BOB and len(D) in (4, 5):
        return Distortion((D[0], D[1], *D[4:]), tangential=(D[2], D[3]))
    if model in ("rational_polynomial", *PLUMB_BOB) and len(D) >= 8 and not np.any(D[8:]):
        return Distortion((D[0], D[1], D[4]), (D[5], D[6], D[7]), (D[2], D[3]))
    if model in EQUIDISTANT and len(D) == 4:
        return Distortion((D[0], D[1], D[2], D[3]), fisheye=True)
    raise InputError(
        f"{where}: the lens model {model[:40]!r} of {len(D)} coefficients is not supported (plumb_bob, "
        "rational_polynomial, equidistant): give source.intrinsics, or rectified images"
    )


def colmap_intrinsics(model: str, params: Sequence[float]) -> tuple[float, float, float, float, Distortion] | None:
    """Convert a COLMAP camera to (fx, fy, cx, cy, distortion).

    Args:
        model: Name of the camera model.
        params: Its parameters, in COLMAP's order.

    Returns:
        The intrinsics, or None if the model is not supported.
    """
    p = [float(value) for value in params]
    if model.startswith(("SIMPLE_", "RADIAL")):  # one focal length
        p.insert(0, p[0])
    if len(p) < 4:
        return None
    lens = colmap_lens(model, p[4:])
    return None if lens is None else (p[0], p[1], p[2], p[3], lens)


def colmap_lens(model: str, k: Sequence[float]) -> Distortion | None:
    """Convert the coefficients of a COLMAP camera, which follow fx, fy, cx, cy; None if the model is not supported."""
    if model in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        return Distortion(numerator=tuple(k))
    if model == "OPENCV":
        return Distortion(numerator=tuple(k[:2]), tangential=(k[2], k[3]))
    if model == "FULL_OPENCV":
        k1, k2, p1, p2, k3, k4, k5, k6 = k
        return Distortion((k1, k2, k3), (k4, k5, k6), (p1, p2))
    if model in ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"):
        return Distortion(numerator=tuple(k), fisheye=True)
    if model == "FOV":
        return Distortion(fov=k[0])
    if model == "THIN_PRISM_FISHEYE":
        k1, k2, p1, p2, k3, k4, sx1, sy1 = k
        return Distortion((k1, k2, k3, k4), (), (p1, p2), fisheye=True, prism=(sx1, 0.0, sy1, 0.0))
    if model == "RAD_TAN_THIN_PRISM_FISHEYE":
        prism = k[8], k[9], k[10], k[11]
        return Distortion(tuple(k[:6]), (), (k[7], k[6]), fisheye=True, prism=prism, radial_first=True)
    return None

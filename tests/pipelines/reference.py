"""A plain float64 splatting renderer in NumPy: the equations as the papers print them, one Gaussian after the other.

It shares no code with `pipelines/`, knows neither tiles nor culling, and takes its rotations and spherical harmonics
from SciPy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from fields.geometry.camera import PinholeCamera

ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.99
BLUR = 0.3
# The projection is linearised no further out than 15 % of the image beyond each border (3DGS: 1.3 tan(fov / 2)).
MARGIN = 0.15


@dataclass(frozen=True)
class Splats:
    """Gaussians in image space, nearest first.

    index (N,): of the Gaussian. mean (N, 2), covariance (N, 2, 2) with the blur, opacity (N,) compensated,
    colour (N, 3), depth (N,).
    """

    index: NDArray[np.int64]
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    opacity: NDArray[np.float64]
    colour: NDArray[np.float64]
    depth: NDArray[np.float64]

    def alpha(self, width: int, height: int) -> NDArray[np.float64]:
        """Alpha (N, H, W) at the pixel centres, neither clamped nor cut off."""
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        d = np.stack([x, y], axis=-1) - self.mean[:, None, None]  # (N, H, W, 2)
        power = -0.5 * np.einsum("nyxi,nij,nyxj->nyx", d, np.linalg.inv(self.covariance), d)
        return self.opacity[:, None, None] * np.exp(power)


@dataclass(frozen=True)
class Picture:
    """colour (H, W, 3), depth (H, W), opacity (H, W).

    margin: by which relative change of an alpha some pixel would fall on the other side of the threshold; a float32
    renderer can be held against this picture only where it is far above float32 rounding.
    """

    colour: NDArray[np.float64]
    depth: NDArray[np.float64]
    opacity: NDArray[np.float64]
    margin: float


def sh_basis(degree: int, directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Real spherical harmonics (N, (degree + 1)^2) of unit directions (N, 3), signs as in 3DGS files.

    3DGS keeps the Condon-Shortley phase: sqrt(2) Re Y_l^m for m > 0, sqrt(2) Im Y_l^|m| for m < 0.
    """
    x, y, z = directions.T
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    columns = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            value = sph_harm_y(n, abs(m), polar, azimuth)
            columns.append(value.real if m == 0 else np.sqrt(2) * (value.real if m > 0 else value.imag))
    return np.stack(columns, axis=1)


def project(
    state: dict[str, NDArray], camera: PinholeCamera, T_camera_world: NDArray[np.float64], near: float
) -> Splats:
    """EWA splatting [Zwicker 2001] with the anti-aliasing of Mip-Splatting [Yu 2024]."""
    state = {name: np.asarray(value, dtype=np.float64) for name, value in state.items()}
    W, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    p = state["position"] @ W.T + t
    order = np.argsort(p[:, 2], kind="stable")
    order = order[p[order, 2] > near]
    p = p[order]

    limit_left = (-camera.cx - MARGIN * camera.width) / camera.fx
    limit_right = (camera.width - camera.cx + MARGIN * camera.width) / camera.fx
    limit_top = (-camera.cy - MARGIN * camera.height) / camera.fy
    limit_bottom = (camera.height - camera.cy + MARGIN * camera.height) / camera.fy

    mean, covariance, opacity = [], [], []
    for i, (x, y, z) in zip(order, p, strict=True):
        R = Rotation.from_quat(state["quaternion"][i], scalar_first=True).as_matrix()
        S = np.diag(np.exp(state["log_scale"][i]))
        xc, yc = np.clip(x / z, limit_left, limit_right) * z, np.clip(y / z, limit_top, limit_bottom) * z
        J = np.array([[camera.fx / z, 0, -camera.fx * xc / z**2], [0, camera.fy / z, -camera.fy * yc / z**2]])
        sharp = J @ W @ R @ S @ S.T @ R.T @ W.T @ J.T
        blurred = sharp + BLUR * np.eye(2)
        compensation = np.sqrt(np.linalg.det(sharp) / np.linalg.det(blurred))
        mean.append([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
        covariance.append(blurred)
        opacity.append(compensation / (1 + np.exp(-state["opacity_logit"][i])))

    centre = -W.T @ t
    rays = state["position"][order] - centre
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    sh = state["sh"][order]
    degree = int(np.sqrt(sh.shape[1])) - 1
    colour = np.maximum(0.5 + np.einsum("nk,nkc->nc", sh_basis(degree, rays), sh), 0.0)
    return Splats(
        order,
        np.array(mean).reshape(-1, 2),
        np.array(covariance).reshape(-1, 2, 2),
        np.array(opacity),
        colour,
        p[:, 2],
    )


def composite(
    splats: Splats, width: int, height: int, background: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Picture:
    """Front to back at every pixel: Eq. 3 of 3DGS, with its thresholds."""
    colour, depth = np.zeros((height, width, 3)), np.zeros((height, width))
    T = np.ones((height, width))
    margin = np.inf
    for alpha, c, z in zip(splats.alpha(width, height), splats.colour, splats.depth, strict=True):
        margin = min(margin, np.abs(np.log(np.maximum(alpha, 1e-300) / ALPHA_MIN)).min(initial=np.inf))
        drawn = np.where(alpha >= ALPHA_MIN, np.minimum(alpha, ALPHA_MAX), 0.0)
        colour += (drawn * T)[..., None] * c
        depth += drawn * T * z
        T = T * (1 - drawn)
    return Picture(colour + T[..., None] * background, depth, 1 - T, float(margin))


def render(
    state: dict[str, NDArray],
    camera: PinholeCamera,
    T_camera_world: NDArray[np.float64],
    near: float,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Picture:
    """The picture of the Gaussians in `state` (see `GaussianField.to_numpy`)."""
    return composite(project(state, camera, T_camera_world, near), camera.width, camera.height, background)

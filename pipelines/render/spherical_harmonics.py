"""Real spherical harmonics up to degree 3, with the order and signs of 3DGS files."""
# pyright: reportInvalidTypeForm=false

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import SH_C0
from fields.runtime.engine import ti

# Number of directions in the fit of a rotation matrix, more than the 16 harmonics.
DIRECTIONS = 64


@ti.func
def _band1(sh: ti.template(), i, x, y, z):
    return 0.4886025119029199 * (z * sh[i, 2] - y * sh[i, 1] - x * sh[i, 3])


@ti.func
def _band2(sh: ti.template(), i, x, y, z):
    return (
        1.0925484305920792 * (x * y * sh[i, 4] - y * z * sh[i, 5] - x * z * sh[i, 7])
        + 0.31539156525252005 * (2.0 * z * z - x * x - y * y) * sh[i, 6]
        + 0.5462742152960396 * (x * x - y * y) * sh[i, 8]
    )


@ti.func
def _band3(sh: ti.template(), i, x, y, z):
    return (
        -0.5900435899266435 * y * (3.0 * x * x - y * y) * sh[i, 9]
        + 2.890611442640554 * x * y * z * sh[i, 10]
        - 0.4570457994644658 * y * (4.0 * z * z - x * x - y * y) * sh[i, 11]
        + 0.3731763325901154 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y) * sh[i, 12]
        - 0.4570457994644658 * x * (4.0 * z * z - x * x - y * y) * sh[i, 13]
        + 1.445305721320277 * z * (x * x - y * y) * sh[i, 14]
        - 0.5900435899266435 * x * (x * x - 3.0 * y * y) * sh[i, 15]
    )


@ti.func
def evaluate_sh(degree: ti.template(), sh: ti.template(), i, d):
    """Sum of coefficients sh[i, k] (3) times the basis in the unit direction d (3,), without the offset of 0.5.

    Each degree is a single expression, since an accumulated colour would need a stack in the reverse kernel.
    """
    x, y, z = d[0], d[1], d[2]
    # A zero of the type of sh, since a literal would make the bands float32 in a float64 render.
    none = 0.0 * sh[i, 0]
    band1, band2, band3 = none, none, none
    if ti.static(degree >= 1):
        band1 = _band1(sh, i, x, y, z)
    if ti.static(degree >= 2):
        band2 = _band2(sh, i, x, y, z)
    if ti.static(degree >= 3):
        band3 = _band3(sh, i, x, y, z)
    return SH_C0 * sh[i, 0] + band1 + band2 + band3


@ti.func
def add_sh_gradient(degree: ti.template(), sh_grad: ti.template(), i, d, g):
    """Add d loss / d coefficients to sh_grad[i, k] (3), given d loss / d `evaluate_sh`, g (3), in direction d (3)."""
    for k, function in ti.static(enumerate(_functions(degree, d[0], d[1], d[2]))):
        sh_grad[i, k] = sh_grad[i, k] + function * g  # no atomic, since the caller has each i once


def sh_basis(degree: int, directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Evaluate the harmonics in NumPy, see `evaluate_sh`.

    Args:
        degree: Highest degree.
        directions: Unit directions (N, 3).

    Returns:
        Basis functions (N, K), K = (degree + 1)^2.
    """
    functions = _functions(degree, *directions.T)
    return np.stack([np.broadcast_to(function, len(directions)) for function in functions], axis=1)


def _functions(degree: int, x: Any, y: Any, z: Any) -> list[Any]:
    """Basis functions in the unit direction (x, y, z), which is of NumPy arrays or of expressions in a kernel."""
    xx, yy, zz = x * x, y * y, z * z
    bands = [
        [SH_C0],
        [0.4886025119029199 * b for b in (-y, z, -x)],
        [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2.0 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ],
        [
            -0.5900435899266435 * y * (3.0 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4.0 * zz - xx - yy),
            0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -0.4570457994644658 * x * (4.0 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3.0 * yy),
        ],
    ]
    return [function for band in bands[: degree + 1] for function in band]


def sh_rotation(degree: int, rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix that rotates coefficients of the harmonics.

    The coefficients M c have the same value in direction R d as c in direction d. Since the bands are closed under
    rotation, a least-squares fit over enough directions is exact.

    Args:
        degree: Highest degree.
        rotation: Rotation R (3, 3).

    Returns:
        M (K, K), K = (degree + 1)^2.
    """
    directions, inverse = _fit(degree)
    M = inverse @ sh_basis(degree, directions @ rotation)
    bands = np.concatenate([np.full(2 * band + 1, band) for band in range(degree + 1)])
    return np.where(bands[:, None] == bands, M, 0.0)


@lru_cache(maxsize=4)
def _fit(degree: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (N, 3) that cover the sphere, and the pseudo-inverse (K, N) of the harmonics in them."""
    i = np.arange(DIRECTIONS) + 0.5
    z, angle = 1.0 - 2.0 * i / DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * i
    radius = np.sqrt(1.0 - z * z)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    return directions, np.asarray(np.linalg.pinv(sh_basis(degree, directions)), dtype=np.float64)

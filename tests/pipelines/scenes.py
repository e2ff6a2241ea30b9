"""Small random scenes before a camera, for the tests of rendering."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3, inverse_se3
from tests.spread import disturbed

NEAR = 0.05
# Neither square, nor a multiple of the tiles, nor centred.
CAMERA = PinholeCamera(52.0, 47.0, 22.3, 15.1, 43, 35)
# A pose that is no identity, so that no transposed rotation goes unnoticed.
POSE = exp_se3([0.3, -0.2, 0.4, 0.3, -0.5, 0.8])


def random_gaussians(
    n: int,
    seed: int,
    degree: int = 0,
    camera: PinholeCamera = CAMERA,
    pose: NDArray[np.float64] = POSE,
    depth: tuple[float, float] = (2.0, 6.0),
    size: tuple[float, float] = (0.5, 5.0),
    logit: tuple[float, float] = (-2.0, 3.0),
    beyond: float = 0.2,
) -> dict[str, NDArray[np.float64]]:
    """N Gaussians that a camera sees: `size` in pixels, centres up to `beyond` images outside the picture.

    Quaternions are not normalised; colours keep clear of the cut at zero.
    """
    rng = np.random.default_rng(seed)
    z = rng.uniform(*depth, n)
    pixels = rng.uniform(-beyond, 1 + beyond, (n, 2)) * [camera.width, camera.height]
    T_world_camera = inverse_se3(pose)
    sh = rng.uniform(-0.1, 0.1, (n, (degree + 1) ** 2, 3))
    sh[:, 0] = rng.uniform(-1.0, 1.5, (n, 3))
    state = {
        "position": camera.unproject(pixels, z) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3],
        "log_scale": np.log(np.exp(rng.uniform(*np.log(size), (n, 3))) * np.abs(z)[:, None] / camera.focal),
        "quaternion": rng.normal(size=(n, 4)) * rng.uniform(0.5, 2.0, (n, 1)),
        "opacity_logit": rng.uniform(*logit, n),
        "sh": sh,
    }
    return {name: disturbed(value) for name, value in state.items()}

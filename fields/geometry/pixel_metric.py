"""Motion of the image by a small motion of the camera, and the metric of SE(3)'s tangent that it defines."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera

# Depths at which the metric samples a view [median depths].
NEAR_AND_FAR = (0.6, 1.6)


def pixel_jacobian(camera: PinholeCamera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Jacobian of pixel positions with respect to a pose increment exp(xi) at xi = 0.

    Args:
        camera: Intrinsics.
        points: Points (N, 3) in the camera frame, with z > 0.

    Returns:
        d pixel / d xi (N, 2, 6).
    """
    x, y, z = points.T
    fx, fy, zero = camera.fx / z, camera.fy / z, np.zeros(len(points))
    by_point = np.stack([fx, zero, -fx * x / z, zero, fy, -fy * y / z], axis=1).reshape(-1, 2, 3)
    # exp(xi) p = p + rho + omega x p
    turned = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    return np.concatenate([by_point, by_point @ turned], axis=2)


# Each keyframe has a depth of its own, and a refinement draws from all of them.
@lru_cache(maxsize=4096)
def pixel_metric(camera: PinholeCamera, median_depth: float) -> NDArray[np.float64]:
    """Coordinates of a pose's tangent in which step lengths are in pixels.

    With xi = W u, a step u moves the image by |u| px: the root mean square over a grid of pixels at two depths. This
    decorrelates small rotations and translations, which move the image in similar ways, and cancels the scale of the
    scene.

    Args:
        camera: Camera of the view.
        median_depth: Median depth of the view [scene units].

    Returns:
        W (6, 6), read-only.
    """
    across, down = (np.arange(0.1, 1.0, 0.2) * side for side in (camera.width, camera.height))
    grid = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    p = np.concatenate([camera.unproject(grid, np.full(len(grid), d * median_depth)) for d in NEAR_AND_FAR])
    J = pixel_jacobian(camera, p).reshape(-1, 6)
    W = np.linalg.inv(np.linalg.cholesky(J.T @ J / len(p))).T
    W.flags.writeable = False
    return W

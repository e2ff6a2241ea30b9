"""Open3D, which is imported on demand, and `points.ply`, the map as a coloured point cloud."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import NO_ORIGIN
from fields.map.gaussians import SH_C0
from modp_ti.files.atomic import written_aside
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.splat_packing import opacities

__all__ = ["open3d", "write_points"]

# Gaussians below this opacity are haze rather than surface.
LEAST_OPACITY = 0.5


def open3d() -> ModuleType:
    """Import and return Open3D.

    Raises:
        InputError: If the import fails, most often because of a missing system library.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise InputError(
            f"Open3D does not start ({error}); on Debian or Ubuntu: apt-get install libusb-1.0-0 libgomp1 libgl1"
        ) from None
    return open3d


def write_points(
    path: str | os.PathLike[str], state: Mapping[str, NDArray], origin: NDArray[np.float64] = NO_ORIGIN
) -> int:
    """Write the centres of the opaque Gaussians with their constant colours as binary PLY.

    Args:
        path: The file.
        state: Gaussians by name, as from `GaussianField.to_numpy`.
        origin: Where their origin lies in the world (3,), which the points are written in.

    Returns:
        Number of points.
    """
    o3d = open3d()
    solid = opacities(state) >= LEAST_OPACITY
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(state["position"][solid].astype(np.float64) + origin))
    colours = np.clip(0.5 + SH_C0 * state["sh"][solid, 0].astype(np.float64), 0.0, 1.0)
    cloud.colors = o3d.utility.Vector3dVector(colours)
    with written_aside(Path(path)) as partial:
        if not o3d.io.write_point_cloud(str(partial), cloud):
            raise OSError(None, "Open3D could not write the points")
    return int(solid.sum())

"""Writes a tileset of 3D Tiles 1.1 with one tile: a glTF file, and where on the Earth it is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.atomic import replace_text
from modp_ti.outputs.locating.georeference import axes_at, ecef


def write_tileset(
    path: Path,
    content: Path,
    origin: NDArray[np.float64],
    offset: NDArray[np.float64],
    bounds: NDArray[np.float64],
) -> None:
    """Write the tileset of a glTF file next to it.

    The tile's axes are east, north and up, as readers turn those of glTF, whose y is up. `extras` has the origin, and
    the projection to metres east and north of it in PROJ's words, for other programs.

    Args:
        path: The file.
        content: The glTF file.
        origin: Latitude [degrees], longitude [degrees] and height [m] of the world's origin.
        offset: Place (3,) of the file's zero in the world, whose x is east, y down and z north [m].
        bounds: Lowest and highest coordinates (2, 3) in the file's axes before they were turned, which are the world's.
    """
    axes, enu = axes_at(origin), [0, 2, 1]
    transform = np.eye(4)
    transform[:3, :3] = axes[:, enu] * [1.0, 1.0, -1.0]
    transform[:3, 3] = ecef(origin) + axes @ offset
    middle = (bounds.mean(axis=0) * [1.0, -1.0, 1.0])[enu]
    half = 0.5 * np.ptp(bounds, axis=0)[enu]
    latitude, longitude, height = origin.tolist()
    tile = {
        "transform": transform.T.ravel().tolist(),
        "boundingVolume": {"box": [*middle.tolist(), *np.diag(half).ravel().tolist()]},
        "geometricError": 0.0,
        "refine": "REPLACE",
        "content": {"uri": content.name},
    }
    extras = {
        "origin": {"latitude": latitude, "longitude": longitude, "height": height},
        "offset": offset.tolist(),
        "projection": f"+proj=tmerc +lat_0={latitude!r} +lon_0={longitude!r} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m",
    }
    size = 2.0 * float(np.linalg.norm(half))
    tileset = {"asset": {"version": "1.1"}, "extras": extras, "geometricError": size, "root": tile}
    replace_text(path, json.dumps(tileset, indent=1) + "\n")

"""A tileset places what a glTF file shows where geodesy says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from modp_ti.outputs.formats.tileset import write_tileset

RADIUS, POLAR = 6_378_137.0, 6_356_752.3142


@pytest.mark.parametrize(
    ("origin", "expected"),
    [  # where east, north and up are axes of the Earth
        ([0.0, 0.0, 50.0], lambda e, n, u: [RADIUS + 50.0 + u, e, n]),
        ([0.0, 90.0, 0.0], lambda e, n, u: [-e, RADIUS + u, n]),
        ([90.0, 0.0, 7.0], lambda e, n, u: [-n, e, POLAR + 7.0 + u]),
    ],
)
def test_points_of_the_file_come_to_their_places(tmp_path: Path, origin: list[float], expected) -> None:
    offset = np.array([3.0, -2.0, 5.0])
    stored = np.random.default_rng(1).normal(0.0, 9.0, (20, 3))  # x east, y down, z north
    bounds = np.stack([stored.min(axis=0), stored.max(axis=0)])
    write_tileset(tmp_path / "a.tileset.json", tmp_path / "a.glb", np.array(origin), offset, bounds)
    tileset = json.loads((tmp_path / "a.tileset.json").read_text())
    tile = tileset["root"]
    assert tile["content"]["uri"] == "a.glb"
    gltf = stored * [1.0, -1.0, -1.0]  # the half turn to y up
    z_up = np.stack([gltf[:, 0], -gltf[:, 2], gltf[:, 1]], axis=1)  # as 3D Tiles turns glTF
    M = np.reshape(tile["transform"], (4, 4)).T
    found = np.c_[z_up, np.ones(len(z_up))] @ M.T
    e, d, n = (stored + offset).T
    np.testing.assert_allclose(found[:, :3], np.transpose(expected(e, n, -d)), atol=1e-3)
    box = np.reshape(tile["boundingVolume"]["box"], (4, 3))
    inside = (z_up - box[0]) @ np.linalg.inv(box[1:])
    assert (np.abs(inside) < 1.0 + 1e-9).all() and np.abs(inside).max() > 1.0 - 1e-9

"""The picture of a mesh against a plane that is known."""

from __future__ import annotations

import mesh_picture
import numpy as np

from fields.geometry.camera import PinholeCamera
from modp_ti.outputs.formats.open3d_io import open3d

CAMERA = PinholeCamera(40.0, 40.0, 32.0, 24.0, 64, 48)


def plane(z: float, right: float):
    """A square at depth z from x = -right to right, red on its left and blue on its right."""
    o3d = open3d()
    corners = [[-right, -9, z], [right, -9, z], [right, 9, z], [-right, 9, z]]
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(corners), o3d.utility.Vector3iVector([[0, 1, 2], [0, 2, 3]])
    )
    mesh.vertex_colors = o3d.utility.Vector3dVector([[1, 0, 0], [0, 0, 1], [0, 0, 1], [1, 0, 0]])
    return mesh


def test_a_pixel_has_the_colour_of_the_place_that_it_sees():
    coloured, grey = mesh_picture.pictures(plane(4.0, 2.0), CAMERA, np.eye(4))
    x = CAMERA.unproject(np.array([[column + 0.5, 10.5] for column in range(64)]), np.full(64, 4.0))[:, 0]
    seen = np.abs(x) < 2.0
    share = (x[seen] + 2.0) / 4.0
    np.testing.assert_allclose(coloured[10, seen], np.stack([1 - share, 0 * share, share], axis=1), atol=1e-5)
    assert (coloured[10, ~seen] == mesh_picture.BACKGROUND).all() and (~seen).sum() == 24
    # Brightest where the ray meets the plane at right angles.
    facing = CAMERA.unproject(np.array([[32.0, 24.0], [22.5, 24.0]]), np.ones(2))
    for pixel, ray in zip((32, 22), facing, strict=True):
        expected = 0.15 + 0.75 / np.linalg.norm(ray)
        np.testing.assert_allclose(grey[24, pixel], expected, atol=2e-3)


def test_a_camera_elsewhere_sees_it_from_there():
    T = np.eye(4)
    T[2, 3] = 4.0  # four behind: everything is seen half as large
    near, _ = mesh_picture.pictures(plane(4.0, 2.0), CAMERA, np.eye(4))
    far, _ = mesh_picture.pictures(plane(4.0, 2.0), CAMERA, T)
    width = [(picture[24] != mesh_picture.BACKGROUND).any(axis=1).sum() for picture in (near, far)]
    assert width == [40, 20]

"""What all replayed trackers share: poses are checked, points are those that the delivered image shows."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.files.trajectory import checked_pose
from modp_ti.inputs.readers.colmap import ColmapSettings
from modp_ti.inputs.readers.transforms import TransformsSettings
from modp_ti.inputs.replay import points_inside
from modp_ti.inputs.source_settings import SourceSettings
from modp_ti.inputs.sources import Undistorter
from tests.opening import opened_with


def test_nearly_rigid_pose_becomes_the_nearest_rigid_one():
    R = Rotation.from_euler("xyz", [0.3, -0.7, 2.0]).as_matrix()
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = 1.001 * R, [1, 2, 3]
    pose = checked_pose(T, "frame")
    np.testing.assert_allclose(pose[:3, :3], R, atol=1e-12)
    assert pose[:3, 3].tolist() == [1, 2, 3]
    with pytest.raises(InputError, match=r"^frame: the pose is no rigid motion"):
        checked_pose(np.diag([1.1, 1.1, 1.1, 1.0]), "frame")


def test_only_known_points_before_the_camera_and_inside_the_image_are_delivered():
    undistorter = Undistorter(PinholeCamera(100, 100, 50, 40, 100, 80))
    xyz = np.array([[0, 0, 2.0], [0, 0, -2.0], [0, 0, 3.0], [0, 0, 3.0], [np.nan, 0, 1.0]])
    pixels = np.array([[50, 40], [50, 40], [100.0, 40], [np.nan, 1], [5, 5]])
    points = points_inside(xyz, pixels, np.arange(10, 15), undistorter, np.eye(4))
    assert points.ids.tolist() == [10]
    assert points.xyz.tolist() == [[0, 0, 2]] and points.pixels.tolist() == [[50, 40]]


@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_masks_of_the_source_reach_the_frames_and_take_their_points_away(plane_scene, kind):
    """Valid in the upper two thirds, painted over in the left quarter; through a lens, at half size."""
    width, height = plane_scene.size
    masks = plane_scene.folder.parent / "masks"
    masks.mkdir()
    mask = np.zeros((height, width), np.uint8)
    mask[: 2 * height // 3] = 255
    for name in plane_scene.names:
        cv2.imwrite(str(masks / name), mask)
        image = np.array(Image.open(plane_scene.folder / name))
        image[:, : width // 4] = (255, 0, 0)
        Image.fromarray(image).save(plane_scene.folder / name)
    rng = np.random.default_rng(2)
    xyz = np.c_[rng.uniform(-1.8, 1.8, (60, 2)), np.zeros(60)]
    source = {"path": plane_scene.folder, "scale": 0.5}
    if kind == "colmap":
        plane_scene.write_colmap(xyz)
        opened = partial(opened_with, tracker=ColmapSettings())
    else:
        rows = "\n".join(" ".join(map(repr, row)) for row in xyz.tolist())
        properties = "".join(f"property double {axis}\n" for axis in "xyz")
        header = f"ply\nformat ascii 1.0\nelement vertex {len(xyz)}\n{properties}end_header\n"
        (plane_scene.folder.parent / "points.ply").write_text(f"{header}{rows}\n")
        plane_scene.write_transforms(ply_file_path="points.ply", k1=-0.15)
        opened = partial(opened_with, tracker=TransformsSettings())
    plain = list(opened(SourceSettings(**source)))
    masked = list(opened(SourceSettings(**source, masks=masks, mask_colour=(255, 0, 0))))
    lost = 0
    for before, after in zip(plain, masked, strict=True):
        camera = after.camera
        ideal = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1) + 0.5
        ray = (ideal - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        if kind == "transforms":
            ray = ray * (1 - 0.15 * (ray**2).sum(axis=-1, keepdims=True))
        stored = (ray * (camera.fx, camera.fy) + (camera.cx, camera.cy)) * 2
        from_the_left, from_the_end = stored[..., 0] - width // 4, 2 * height // 3 - stored[..., 1]
        sure = (np.abs(from_the_left) > 3) & (np.abs(from_the_end) > 3)
        expected = (from_the_left > 0) & (from_the_end > 0)
        if before.mask is not None:
            expected &= before.mask
        assert after.mask is not None
        np.testing.assert_array_equal(after.mask[sure], expected[sure])
        column, row = after.points.pixels.astype(int).T
        assert after.mask[row, column].all()
        lost += len(before.points) - len(after.points)
        # What is not masked is as it was, away from the edges of the paint.
        np.testing.assert_allclose(after.image[sure & after.mask], before.image[sure & after.mask], atol=0.01)
    assert lost > 50


def test_a_missing_mask_ends_the_run_before_the_points_are_triangulated(plane_scene):
    masks = plane_scene.folder.parent / "masks"
    masks.mkdir()
    cv2.imwrite(str(masks / plane_scene.names[0]), np.full(plane_scene.size[::-1], 255, np.uint8))
    plane_scene.write_transforms()
    with pytest.raises(InputError, match=r"has no mask for view9\.png"):
        opened_with(
            SourceSettings(path=plane_scene.folder, masks=masks),
            TransformsSettings(),
            lambda *_: pytest.fail("it began"),
        )

"""Cameras and poses of images as they are stored are turned with the images that EXIF asks to be turned."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from modp_ti.files.errors import InputError
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.readers.colmap import ColmapSettings
from modp_ti.inputs.readers.transforms import TransformsSettings
from modp_ti.inputs.source_settings import SourceSettings
from tests.modp_ti.conftest import PlaneScene
from tests.opening import opened_with

COUNTERCLOCKWISE = {3: 2, 6: 1, 8: 3}  # quarter turns from the upright to the stored image, by orientation
POINTS = np.c_[np.random.default_rng(2).uniform(-1.8, 1.8, (60, 2)), np.zeros(60)]


def stored_scene(upright: PlaneScene, orientation: int, folder: Path) -> PlaneScene:
    """The scene as a camera stores it that was held otherwise, with EXIF's orientation."""
    K, T, (width, height) = upright.K, upright.T_camera_world, upright.size
    turns = COUNTERCLOCKWISE.get(orientation, 0)
    for _ in range(turns):
        pixels = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, width], [0.0, 0.0, 1.0]])
        axes = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
        K, T, width, height = pixels @ K @ axes[:3, :3].T, axes @ T, height, width
    (folder / "images").mkdir(parents=True)
    exif = Image.Exif()
    exif[0x0112] = orientation
    names = [name.replace(".png", ".jpg") for name in upright.names]
    for name, source in zip(names, upright.names, strict=True):
        image = cv2.imread(str(upright.folder / source))[..., ::-1]
        Image.fromarray(np.rot90(image, turns)).save(folder / "images" / name, exif=exif, quality=98)
    return replace(upright, folder=folder / "images", names=names, K=K, T_camera_world=T, size=(width, height))


def assert_upright(tracker: Tracker, scene: PlaneScene) -> None:
    """The frames show the scene's images, and their points lie where the scene's camera sees them."""
    frames = list(tracker)
    assert len(frames) == len(scene.names)
    for frame, name, T in zip(frames, scene.names, scene.T_camera_world, strict=True):
        upright = cv2.imread(str(scene.folder / name))[..., ::-1] / 255.0
        assert frame.image.shape == upright.shape and np.abs(frame.image - upright).mean() < 0.05  # JPEG
        assert np.abs(frame.image - upright[::-1, ::-1]).mean() > 0.1
        np.testing.assert_allclose(frame.T_camera_world, T, atol=1e-9)
        np.testing.assert_allclose(frame.camera.matrix(), scene.K, atol=1e-9)
        p = frame.points.xyz @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(((p / p[:, 2:]) @ scene.K.T)[:, :2], frame.points.pixels, atol=1e-6)
        assert len(frame.points) > 20


def colmap(scene: PlaneScene) -> Tracker:
    return opened_with(SourceSettings(path=scene.folder), ColmapSettings())


def transforms(scene: PlaneScene) -> Tracker:
    return opened_with(SourceSettings(path=scene.folder), TransformsSettings())


def write_cloud(scene: PlaneScene) -> None:
    header = f"ply\nformat ascii 1.0\nelement vertex {len(POINTS)}\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    rows = "\n".join(" ".join(map(repr, row)) for row in POINTS.tolist())
    (scene.folder.parent / "points.ply").write_text(f"{header}{rows}\n")


@pytest.mark.parametrize("orientation", COUNTERCLOCKWISE)
def test_a_model_of_the_stored_images_is_turned_with_them(plane_scene, tmp_path, orientation):
    stored = stored_scene(plane_scene, orientation, tmp_path / "stored")
    stored.write_colmap(POINTS)
    tracker = colmap(stored)
    assert_upright(tracker, plane_scene)
    assert sum("are turned with them" in note for note in tracker.notes) == 1
    assert sum("EXIF" in note for note in tracker.notes) == 1


@pytest.mark.parametrize("orientation", COUNTERCLOCKWISE)
@pytest.mark.parametrize("sizes", [{}, {"w": None, "h": None}], ids=["with sizes", "without"])
def test_a_transforms_json_of_the_stored_images_is_turned_with_them(plane_scene, tmp_path, orientation, sizes):
    stored = stored_scene(plane_scene, orientation, tmp_path / "stored")
    write_cloud(stored)
    stored.write_transforms(ply_file_path="points.ply", **sizes)
    tracker = transforms(stored)
    assert_upright(tracker, plane_scene)
    assert sum("are turned with them" in note for note in tracker.notes) == 1


@pytest.mark.parametrize("orientation", [6, 8])
def test_a_model_whose_sizes_are_those_of_the_upright_images_is_kept(plane_scene, tmp_path, orientation):
    stored = stored_scene(plane_scene, orientation, tmp_path / "stored")
    upright = replace(plane_scene, folder=stored.folder, names=stored.names)
    upright.write_colmap(POINTS)
    tracker = colmap(upright)
    assert_upright(tracker, plane_scene)
    assert not any("turned with them" in note for note in tracker.notes)


def test_a_model_of_mirrored_images_is_refused(plane_scene, tmp_path):
    stored = stored_scene(plane_scene, 2, tmp_path / "stored")
    stored.write_colmap(POINTS)
    with pytest.raises(InputError, match=r"mirrors the image.*remove the orientation"):
        colmap(stored)

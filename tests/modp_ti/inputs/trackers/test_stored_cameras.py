"""Cameras and poses of images as they are stored are turned with the images that EXIF asks to be turned."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from tests.opening import assert_poses, off_pixels, opened, refusal
from tests.samples.filmed import Filmed, View
from tests.samples.kinds import write_sample

COUNTERCLOCKWISE = {3: 2, 6: 1, 8: 3}  # quarter turns from the upright to the stored image, by orientation


def turned(view: View, turns: int) -> View:
    """The view as a camera stores it that was held otherwise."""
    for _ in range(turns):
        pixels = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, view.size[0]], [0.0, 0.0, 1.0]])
        axes = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
        pose = view.T_world_camera @ axes.T
        view = View(np.ascontiguousarray(np.rot90(view.image)), pixels @ view.K @ axes[:3, :3].T, pose, view.depth)
    return view


def write(kind: str, folder: Path, upright: Filmed, orientation: int, of_stored: bool = True) -> Path:
    """Write images with EXIF's orientation, and a file of the stored images or of the upright ones."""
    turns = COUNTERCLOCKWISE.get(orientation, 0)
    stored = replace(upright, views=[turned(view, turns) for view in upright.views])
    write_sample(kind, folder, stored if of_stored else upright)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    for name, view in zip(stored.names, stored.views, strict=True):
        Image.fromarray(view.image[..., ::-1]).save(folder / "images" / name, exif=exif)
    return folder


def assert_upright(folder: Path, upright: Filmed, turned_with_them: bool) -> None:
    tracker = opened(folder)
    assert_poses(tracker.frames, upright.views, atol=1e-9)
    for frame, view in zip(tracker, upright.views, strict=True):
        np.testing.assert_array_equal(frame.image, view.image[..., ::-1] / np.float32(255))
        np.testing.assert_allclose(frame.camera.matrix(), upright.K, atol=1e-9)
        assert len(frame.points) > 20 and off_pixels(frame).max() < 1e-5
    assert sum("are turned with them" in note for note in tracker.notes) == turned_with_them
    assert sum("EXIF" in note for note in tracker.notes) == 1


@pytest.mark.parametrize("orientation", COUNTERCLOCKWISE)
@pytest.mark.parametrize("kind", ["colmap", "transforms", "transforms without sizes"])
def test_a_file_of_the_stored_images_is_turned_with_them(filmed, tmp_path, kind, orientation):
    folder = write(kind.split()[0], tmp_path / "a", filmed, orientation)
    if "without" in kind:
        data = json.loads((folder / "transforms.json").read_text())
        (folder / "transforms.json").write_text(json.dumps({key: data[key] for key in data.keys() - {"w", "h"}}))
    assert_upright(folder, filmed, turned_with_them=True)


@pytest.mark.parametrize("orientation", [6, 8])
def test_a_model_whose_sizes_are_those_of_the_upright_images_is_kept(filmed, tmp_path, orientation):
    assert_upright(write("colmap", tmp_path / "a", filmed, orientation, of_stored=False), filmed, False)


def test_a_model_of_mirrored_images_is_refused(filmed, tmp_path):
    assert "remove the orientation" in refusal(write("colmap", tmp_path / "a", filmed, 2))

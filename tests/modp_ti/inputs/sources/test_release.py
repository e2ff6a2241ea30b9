"""The paper's release of Aria sequences: images, camera and vignette."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from modp_ti.config.settings import SourceSettings
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.sources import FrameReader


@pytest.fixture
def release(tmp_path):
    (tmp_path / "rectified").mkdir()
    for name in ("2.png", "10.png"):
        cv2.imwrite(str(tmp_path / "rectified" / name), np.full((800, 800, 3), 100, np.uint8))
    (tmp_path / "trajectory.json").write_text('{"cameras": []}')
    return tmp_path


def test_images_and_camera_are_those_of_the_release(release):
    made = open_source(SourceSettings(path=release, scale=1.0))
    assert tuple(made.names) == ("2.png", "10.png")
    camera = made.intrinsics.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height) == (400, 400, 400, 400, 800, 800)
    assert made.vignette is None
    assert made.notes == [f"{release} is read as what `source.kind: release` says"]


def test_its_vignette_comes_with_the_frames_unless_another_is_given(release, tmp_path):
    light = np.linspace(0, 200, 800).astype(np.uint8)
    cv2.imwrite(str(release / "vignette.png"), np.tile(light, (800, 1)))
    settings = SourceSettings(path=release, scale=0.5)
    made = open_source(settings)
    picture = FrameReader(made, settings).read("2.png", made.intrinsics.undistorter(0.5))
    np.testing.assert_allclose(picture.vignette[7, 300], 600 / 799, atol=0.01)
    # Where less than a twentieth of the light arrives a pixel is masked: columns up to 40 of 800.
    assert not picture.mask[:, :19].any() and picture.mask[:, 21:].all()

    other = tmp_path / "even.png"
    cv2.imwrite(str(other), np.full((80, 80), 255, np.uint8))
    settings = SourceSettings(path=release, vignette=other)
    made = open_source(settings)
    assert made.vignette is None
    picture = FrameReader(made, settings).read("2.png", made.intrinsics.undistorter(1.0))
    assert picture.vignette.min() == 1.0

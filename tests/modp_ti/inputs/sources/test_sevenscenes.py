"""A 7-Scenes folder: colour images by frame number, nominal intrinsics, and what is said of them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from modp_ti.config.settings import SourceSettings
from modp_ti.inputs.opening import open_source


def sequence(folder, *names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.zeros((480, 640, 3), np.uint8))
    return folder


NAMES = ("frame-000002.color.png", "frame-000004.color.png", "frame-000011.color.png")


@pytest.mark.parametrize("inside", [".", "images"])
def test_colour_images_are_taken_alone_and_timed_by_their_number(tmp_path, inside):
    sequence(tmp_path / inside, *NAMES, "frame-000002.depth.png", "other.png")
    made = open_source(SourceSettings(path=tmp_path, scale=1.0))
    assert tuple(made.names) == NAMES
    np.testing.assert_allclose([made.timestamp(name) for name in NAMES], np.array([2, 4, 11]) / 30)
    camera = made.intrinsics.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (525, 525, 320, 240)
    assert made.notes == [f"{tmp_path} is read as what `source.kind: sevenscenes` says"]


def test_real_sequence(shared_data):
    made = open_source(SourceSettings(path=shared_data("redkitchen")))
    assert len(made) == 1000
    assert made.names[999] == "frame-000999.color.jpg"
    assert made.timestamp(made.names[90]) == 3.0
    assert made.size(made.names[500]) == (640, 480)

"""A Replica folder: colour images in order, with the data set's camera where they have its size."""

from __future__ import annotations

import cv2
import numpy as np

from modp_ti.config.settings import SourceSettings
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.sources import require_intrinsics


def room(folder, width=1200, height=680):
    (folder / "results").mkdir()
    for name in ("frame000000.jpg", "frame000001.jpg", "frame000010.jpg", "depth000000.png"):
        cv2.imwrite(str(folder / "results" / name), np.zeros((height, width, 3), np.uint8))
    (folder / "traj.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n")
    return folder


def test_colour_images_are_listed_with_the_data_sets_camera(tmp_path):
    made = open_source(SourceSettings(path=room(tmp_path), fps=10, scale=1.0))
    assert tuple(made.names) == ("frame000000.jpg", "frame000001.jpg", "frame000010.jpg")
    assert [made.timestamp(name) for name in made.names] == [0.0, 0.1, 0.2]
    assert made.find("results/frame000010.jpg") == "frame000010.jpg"
    assert made.read("frame000001.jpg").shape == (680, 1200, 3)
    camera = require_intrinsics(made).camera
    # cx 599.5 with pixel centres at whole numbers is the middle: half of the image's width where they lie at +0.5.
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (600, 600, 1200 / 2, 680 / 2)
    assert made.notes == [f"{tmp_path} is read as what `source.kind: replica` says"]

"""A TUM RGB-D folder: the listing's images and times, the benchmark's cameras, and faults named by file and line."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from modp_ti.config.settings import SourceSettings
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.readers.tum import TumSettings

IMAGE = np.zeros((480, 640, 3), np.uint8)


def opened(folder):
    return TumSettings.open_images(folder, SourceSettings(path=folder))


@pytest.fixture
def sequence(tmp_path):
    """Writes `rgb.txt` of a sequence in a folder of the given name, and two of the images that it may list."""

    def make(listing: str, name: str = "rgbd_dataset_freiburg2_xyz"):
        folder = tmp_path / name
        (folder / "rgb").mkdir(parents=True)
        for time in ("10.25", "10.75"):
            cv2.imwrite(str(folder / "rgb" / f"{time}.png"), IMAGE)
        (folder / "rgb.txt").write_text(listing)
        return folder

    return make


LISTING = "# color images\n# timestamp filename\n10.25 rgb/10.25.png\n10.50 rgb/10.50.png\n\n10.75 rgb/10.75.png\n"


def test_images_that_are_there_have_the_listings_times_and_the_others_are_counted(sequence):
    made = opened(sequence(LISTING))
    assert tuple(made.names) == ("rgb/10.25.png", "rgb/10.75.png")
    assert [made.timestamp(name) for name in made.names] == [10.25, 10.75]
    assert made.notes[0].startswith("1 of the 3 images that ") and made.notes[0].endswith("rgb.txt lists are not there")


# fr1's lens after the benchmark's page: with pixel centres at whole numbers, where a point (0.2, -0.1, 1) lands.
# r^2 = 0.05: 1 + 0.2624 r^2 - 0.9531 r^4 + 1.1633 r^6 = 1.0108826625
X = 0.2 * 1.0108826625 + 2 * -0.0054 * 0.2 * -0.1 + 0.0026 * (0.05 + 2 * 0.04)
Y = -0.1 * 1.0108826625 + -0.0054 * (0.05 + 2 * 0.01) + 2 * 0.0026 * 0.2 * -0.1
FR1 = (517.3 * X + 318.6 + 0.5, 516.5 * Y + 255.3 + 0.5)


@pytest.mark.parametrize(
    ("folder", "listing", "number", "pixel"),
    [
        ("rgbd_dataset_freiburg1_desk", LISTING, 1, FR1),
        ("fr1", LISTING, 1, FR1),
        ("desk", "# file: 'rgbd_dataset_freiburg1_desk.bag'\n" + LISTING, 1, FR1),
        ("tum_fr3_office", LISTING, 3, (535.4 * 0.2 + 320.6, 539.2 * -0.1 + 248.1)),
    ],
)
def test_camera_is_that_of_the_folders_name_or_else_of_the_recording(sequence, folder, listing, number, pixel):
    made = open_source(SourceSettings(path=sequence(listing, folder)))
    camera, distortion = made.intrinsics.camera, made.intrinsics.distortion
    x, y = distortion.distort(np.array([0.2, -0.1]))
    np.testing.assert_allclose((camera.fx * x + camera.cx, camera.fy * y + camera.cy), pixel, atol=1e-9)
    assert f"the camera is taken to be the benchmark's freiburg{number}" in made.notes


@pytest.mark.parametrize("folder", ["desk", "fr4_desk", "freiburg12"])
def test_camera_that_nothing_tells_is_asked_for(sequence, folder):
    made = opened(sequence(LISTING, folder))
    assert made.intrinsics is None
    assert "give source.intrinsics" in made.notes[-1]

"""Folders of data sets: their images in order and on time, their cameras, and the vignette of the paper's release."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from modp_ti.inputs.opening import open_source
from modp_ti.inputs.source_settings import SourceSettings
from modp_ti.inputs.sources import FrameReader

SCENES = ("frame-000002.color.png", "frame-000004.color.png", "frame-000011.color.png")
# The folder's files besides, the images' size, names and times [s] at 30 a second, and fx, fy, cx, cy.
LAYOUTS = {
    "release": (["trajectory.json"], (800, 800), ["rectified/2.png", "rectified/10.png"], [0, 1 / 30], (400,) * 4),
    "replica": (
        ["traj.txt", "results/depth000000.png"],
        (1200, 680),
        ["results/frame000000.jpg", "results/frame000010.jpg"],
        [0, 1 / 30],
        (600, 600, 600, 340),
    ),
    "sevenscenes": (["other.png"], (640, 480), SCENES, [2 / 30, 4 / 30, 11 / 30], (525, 525, 320, 240)),
    "sevenscenes, inside": (
        [],
        (640, 480),
        [f"images/{name}" for name in SCENES],
        [2 / 30, 4 / 30, 11 / 30],
        (525, 525, 320, 240),
    ),
}


def write(folder: Path, names: list[str], size: tuple[int, int]) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), np.full((size[1], size[0], 3), 100, np.uint8))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_folder_is_recognised_and_has_its_images_times_and_camera(layout, tmp_path):
    others, size, names, times, camera = LAYOUTS[layout]
    write(tmp_path, names, size)
    for name in others:
        (tmp_path / name).touch()
    made = open_source(SourceSettings(path=tmp_path, scale=1.0))
    assert list(made.names) == [Path(name).name for name in names]
    np.testing.assert_allclose([made.timestamp(name) for name in made.names], times)
    assert made.read(made.names[0]).shape[1::-1] == made.size(made.names[0]) == size
    found = made.intrinsics.camera
    assert (found.fx, found.fy, found.cx, found.cy) == camera
    assert made.notes == [f"{tmp_path} is read as what `source.kind: {layout.partition(',')[0]}` says"]


def test_the_vignette_of_the_release_comes_with_the_frames_unless_another_is_given(tmp_path):
    write(tmp_path, ["rectified/2.png"], (800, 800))
    light = np.linspace(0, 200, 800).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "vignette.png"), np.tile(light, (800, 1)))
    settings = SourceSettings(path=tmp_path, scale=0.5)
    made = open_source(settings)
    picture = FrameReader(made, settings).read("2.png", made.intrinsics.undistorter(0.5))
    np.testing.assert_allclose(picture.vignette[7, 300], 600 / 799, atol=0.01)
    # Where less than a twentieth of the light arrives a pixel is masked: columns up to 40 of 800.
    assert not picture.mask[:, :19].any() and picture.mask[:, 21:].all()
    cv2.imwrite(str(tmp_path / "even.png"), np.full((80, 80), 255, np.uint8))
    settings = SourceSettings(path=tmp_path, vignette=tmp_path / "even.png")
    made = open_source(settings)
    assert FrameReader(made, settings).read("2.png", made.intrinsics.undistorter(1.0)).vignette.min() == 1.0


LISTING = "# color images\n# timestamp filename\n10.25 rgb/10.25.png\n10.50 rgb/10.50.png\n\n10.75 rgb/10.75.png\n"
# fr1's lens after the benchmark's page: with pixel centres at whole numbers, where a point (0.2, -0.1, 1) lands.
# r^2 = 0.05: 1 + 0.2624 r^2 - 0.9531 r^4 + 1.1633 r^6 = 1.0108826625
X = 0.2 * 1.0108826625 + 2 * -0.0054 * 0.2 * -0.1 + 0.0026 * (0.05 + 2 * 0.04)
Y = -0.1 * 1.0108826625 + -0.0054 * (0.05 + 2 * 0.01) + 2 * 0.0026 * 0.2 * -0.1
FR1, FR3 = (517.3 * X + 318.6 + 0.5, 516.5 * Y + 255.3 + 0.5), (535.4 * 0.2 + 320.6, 539.2 * -0.1 + 248.1)


@pytest.mark.parametrize(
    ("folder", "origin", "pixel"),
    [
        ("rgbd_dataset_freiburg1_desk", "", FR1),
        ("fr1", "", FR1),
        ("desk", "# file: 'rgbd_dataset_freiburg1_desk.bag'\n", FR1),
        ("tum_fr3_office", "", FR3),
        ("desk", "", None),
        ("freiburg12", "", None),
    ],
)
def test_tum_has_the_images_of_its_listing_and_the_camera_of_its_name(folder, origin, pixel, tmp_path):
    write(tmp_path / folder, ["rgb/10.25.png", "rgb/10.75.png"], (640, 480))
    (tmp_path / folder / "rgb.txt").write_text(origin + LISTING)
    made = open_source(SourceSettings(path=tmp_path / folder))
    assert list(made.names) == ["rgb/10.25.png", "rgb/10.75.png"]
    assert [made.timestamp(name) for name in made.names] == [10.25, 10.75]
    assert any("1 of the 3 images" in note for note in made.notes)
    if pixel is None:
        assert made.intrinsics is None
        return
    camera, distortion = made.intrinsics.camera, made.intrinsics.distortion
    x, y = distortion.distort(np.array([0.2, -0.1]))
    np.testing.assert_allclose((camera.fx * x + camera.cx, camera.fy * y + camera.cy), pixel, atol=1e-9)

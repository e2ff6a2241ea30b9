"""A folder of images is listed in natural order, decoded as stored, and bad images are named."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources import ImageFolder
from modp_ti.inputs.sources.image_folder import times_of_names

IMAGE = np.random.default_rng(1).integers(0, 255, (20, 30, 3), dtype=np.uint8)


@pytest.fixture
def folder(tmp_path):
    """Makes images of the given names (RGB: `IMAGE`) and opens their folder."""

    def make(*names: str) -> ImageFolder:
        for name in names:
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(tmp_path / name), IMAGE[..., ::-1])
        return ImageFolder(tmp_path)

    return make


def test_names_are_in_natural_order_with_subfolders_and_without_other_files(folder, tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    made = folder("f10.png", "f9.png", "F2.PNG", "f0010.jpg", "b/1.png", ".hidden/1.png", "._f9.png")
    assert tuple(made.names) == ("b/1.png", "F2.PNG", "f9.png", "f0010.jpg", "f10.png")
    assert [made.position(name) for name in made.names] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif", ".tiff", ".ppm"])
def test_pixels_are_rgb_and_exact(folder, suffix):
    made = folder("a" + suffix)
    assert np.array_equal(made.read("a" + suffix), IMAGE)
    assert made.size("a" + suffix) == (30, 20)


def test_pictures_that_are_not_read_are_counted_unless_their_jpeg_is_there(folder, tmp_path):
    (tmp_path / "a.DNG").touch()
    assert folder("a.jpg", "b.jpg").notes == []
    (tmp_path / "c.cr2").touch()
    (note,) = ImageFolder(tmp_path).notes
    assert "c.cr2" in note and "DNG" not in note


@pytest.mark.parametrize("beside", ["depth/1.png", "1.depth.png", "masks/1.png", "left/mask/1.jpg.png"])
def test_depth_maps_and_masks_beside_images_are_no_images(folder, tmp_path, beside):
    deep = np.full((20, 30), 900, np.uint16) if "depth" in beside else np.full((20, 30), 255, np.uint8)
    (tmp_path / beside).parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(tmp_path / beside), deep)
    assert list(ImageFolder(tmp_path).names) == [beside]  # alone, they are taken for images
    made = folder("1.jpg", "2.jpg")
    assert list(made.names) == ["1.jpg", "2.jpg"] and len(made.notes) == 1


def test_the_folder_of_masks_may_lie_among_the_images(folder, tmp_path):
    folder("1.png", "valid/7.png")
    assert list(ImageFolder(tmp_path, masks=tmp_path / "valid").names) == ["1.png"]


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".bmp", ".tif"])
@pytest.mark.parametrize("part", [0.0, 0.1, 0.6, 0.98])
def test_image_that_was_cut_off_is_named(folder, tmp_path, suffix, part, capfd):
    made = folder("good" + suffix, "bad" + suffix)
    file = tmp_path / ("bad" + suffix)
    file.write_bytes(file.read_bytes()[: int(part * file.stat().st_size)])
    for use in (made.read, made.size):
        with pytest.raises(InputError, match=rf"bad\{suffix}: unreadable image: .*; replace it") as caught:
            use("bad" + suffix)
        assert "\n" not in str(caught.value)
    assert made.read("good" + suffix).shape == (20, 30, 3)
    assert capfd.readouterr().err == "", "the decoder's own complaints are kept quiet"


@pytest.mark.parametrize(
    ("asked", "found"),
    [
        ("a/1.png", "a/1.png"),
        ("./a/1.png", "a/1.png"),
        ("dataset/a/1.png", "a/1.png"),
        ("dataset\\a\\1.png", "a/1.png"),
        ("/abs/a/1", "a/1.png"),
        ("3.5", "3.5.png"),
        ("2.jpg", None),
        ("1.png", None),
        ("a", None),
        ("", None),
    ],
)
def test_name_of_a_tracker_is_found_by_its_end_and_without_suffix(folder, asked, found):
    assert folder("a/1.png", "2.png", "3.5.png").find(asked) == found


def test_range_selects_by_position(folder):
    made = folder(*(f"{i}.png" for i in range(12)))
    assert made.selected(1, 8, 3) == ["1.png", "4.png", "7.png"]
    assert made.selected(10, None, 1) == ["10.png", "11.png"]
    with pytest.raises(InputError, match=r"source\.start=12 leaves no frame"):
        made.selected(12, None, 1)


def test_nanoseconds_microseconds_milliseconds_and_seconds_are_told_apart():
    euroc = ["1403636579763555584.png", "1403636579813555456.png"]
    np.testing.assert_allclose(times_of_names(euroc), [1403636579.763555584, 1403636579.813555456], atol=3e-7)
    tum = ["rgb/1305031453.359684.png", "rgb/1305031453.391690.png"]
    assert times_of_names(tum).tolist() == [1305031453.359684, 1305031453.391690]
    assert np.diff(times_of_names(["1403636579763555", "1403636579813555"])) == pytest.approx(0.05, abs=1e-6)
    assert np.diff(times_of_names(["1403636579763", "1403636579813"])) == pytest.approx(0.05, abs=1e-6)


@pytest.mark.parametrize(
    "names",
    [
        ["frame000000.jpg", "frame000001.jpg"],
        ["0000000000.png", "0000000001.png"],  # KITTI counts with ten digits
        ["0000000000000000000.png", "0000000000000000001.png"],
        ["1403636579763555584.png", "0001.png"],
        ["1403636579763555584.png", "a/1403636579763555584.png"],  # not rising
        ["1403636579763.png", "1403636579763555584.png"],
    ],
)
def test_other_names_are_no_times(names):
    assert times_of_names(names) is None

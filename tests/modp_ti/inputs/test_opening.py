"""A source is recognised by what is there, and said; the user's intrinsics win, and must be of the images' size."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_source, recognised_kind
from modp_ti.inputs.source_settings import IntrinsicsSettings, SourceSettings
from modp_ti.inputs.sources import ImageFolder, require_intrinsics


def image(file, width=64, height=48):
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), np.zeros((height, width, 3), np.uint8))


@pytest.mark.parametrize(
    ("files", "kind"),
    [
        (["a.png"], "images"),
        (["images/a.png", "depth/a.png"], "images"),
        (["results/a.png"], "images"),
        (["frame-000000.depth.png"], "images"),
        (["images/frame-000000.color.jpg"], "sevenscenes"),
    ],
)
def test_folder_is_recognised_by_its_layout(tmp_path, files, kind):
    for name in files:
        image(tmp_path / name) if name.endswith((".png", ".jpg")) else (tmp_path / name).write_text("")
    assert recognised_kind(tmp_path) == kind


def test_file_is_recognised_by_its_suffix(tmp_path):
    for name, kind in (("a.MOV", "video"), ("a.webm", "video"), ("a.vrs", "vrs")):
        assert recognised_kind(tmp_path / name) == kind
    (tmp_path / "a.pdf").write_text("")
    with pytest.raises(InputError, match=r"a\.pdf: is neither a folder of images nor a file that \.pdf tells"):
        recognised_kind(tmp_path / "a.pdf")


def test_plain_images_need_no_word_and_may_be_insisted_on(tmp_path):
    image(tmp_path / "frame-000000.color.png")
    image(tmp_path / "frame-000000.depth.png")
    insisted = open_source(SourceSettings(path=tmp_path, kind="images"))
    assert isinstance(insisted, ImageFolder)
    assert len(insisted) == 2 and insisted.notes == [] and insisted.intrinsics is None


def camera_of(tmp_path, **given) -> tuple:
    image(tmp_path / "images" / "a.png")
    source = SourceSettings(path=tmp_path / "images", intrinsics=IntrinsicsSettings(**given))
    return open_source(source).intrinsics


@pytest.mark.parametrize("fisheye", [False, True])
def test_given_intrinsics_are_opencvs_in_our_pixels(tmp_path, fisheye):
    lens = dict.fromkeys(("k1", "k2", "p1", "p2", "k3") if not fisheye else ("k1", "k2", "k3", "k4"), 0.0)
    lens = dict(zip(lens, (0.11, -0.08, 0.003, -0.002, 0.02), strict=False))
    made = camera_of(tmp_path, fx=50.0, fy=51.0, cx=33.0, cy=25.0, fisheye=fisheye, **lens)
    points = np.array([[[0.2, -0.1, 1.0], [-0.5, 0.3, 1.2], [0.0, 0.4, 1.0]]])
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    K = np.array([[50.0, 0, 33.0], [0, 51.0, 25.0], [0, 0, 1]])
    expected, _ = project(points, np.zeros(3), np.zeros(3), K, np.array(list(lens.values())))
    ideal = made.distortion.distort(points[0, :, :2] / points[0, :, 2:])
    found = ideal * (made.camera.fx, made.camera.fy) + (made.camera.cx, made.camera.cy)
    np.testing.assert_allclose(found, expected.reshape(-1, 2), atol=1e-9)
    assert (made.camera.width, made.camera.height) == (64, 48)


def test_given_intrinsics_win_over_the_data_sets(tmp_path):
    image(tmp_path / "results" / "frame000000.jpg", 1200, 680)
    given = IntrinsicsSettings(fx=700.0)
    made = open_source(SourceSettings(path=tmp_path, intrinsics=given))
    assert (made.intrinsics.camera.fx, made.intrinsics.camera.fy) == (700.0, 700.0)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"cx": 16.0, "cy": 12.0}, "cx 16, cy 12 lie far from the middle of the 64x48 images"),
        ({"cx": 64.0, "cy": 48.0}, "cx 64, cy 48 lie far from the middle"),
        ({"width": 128, "height": 96}, "source.intrinsics are for 128x96, the images are 64x48"),
    ],
)
def test_intrinsics_of_another_size_are_refused(tmp_path, given, message):
    with pytest.raises(InputError, match=message):
        camera_of(tmp_path, fx=50.0, **given)


def test_a_principal_point_off_the_middle_is_taken_where_the_size_is_given(tmp_path):
    assert camera_of(tmp_path, fx=50.0, cx=16.0, cy=12.0, width=64, height=48).camera.cx == 16.0


def test_camera_that_is_not_known_is_asked_for(tmp_path):
    image(tmp_path / "a.png")
    with pytest.raises(InputError, match=r"the camera is not known: give source\.intrinsics: \{fx"):
        require_intrinsics(open_source(SourceSettings(path=tmp_path)))


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("{path: a, intrinsics: {cx: 500}}", "source.intrinsics.fx is missing"),
        ("{path: a, intrinsics: {fx: 500, k4: 0.1}}", "source.intrinsics.k4 is only for `fisheye: true`"),
        ("{path: a, intrinsics: {fx: 500, p1: 0.1, fisheye: true}}", "OpenCV's fisheye model has no p1 and p2"),
        ("{path: a, intrinsics: {fx: 500, width: 640}}", "set both width and height, or neither"),
        ("{path: a, kind: film}", "source.kind: must be 'auto', 'images', 'video'"),
    ],
)
def test_settings_that_contradict_each_other_are_refused_by_line(tmp_path, source, message):
    file = tmp_path / "scene.yaml"
    file.write_text(f"tracker: {{kind: colmap}}\noutput: out\nsource: {source}\n")
    with pytest.raises(InputError) as caught:
        load_scene(file)
    assert message in str(caught.value)
    assert str(caught.value).startswith(str(file))


def test_scale_is_chosen_from_the_first_image_that_can_be_read_and_said(tmp_path):
    (tmp_path / "0.png").write_bytes(b"no image")
    image(tmp_path / "1.png", 1920, 1080)
    images = open_source(SourceSettings(path=tmp_path))
    assert images.scale == 0.25
    assert images.notes == ["images of 1920x1080 are mapped at 480x270: source.scale is auto, which makes it 0.25"]
    assert open_source(SourceSettings(path=tmp_path, stop=1)).scale == 1.0


@pytest.mark.parametrize(("width", "given"), [(1920, 1.0), (1920, 0.5), (480, "auto")])
def test_a_scale_that_is_given_and_small_images_need_no_word(tmp_path, width, given):
    image(tmp_path / "a.png", width, width * 9 // 16)
    images = open_source(SourceSettings(path=tmp_path, scale=given))
    assert (images.scale, images.notes) == (1.0 if given == "auto" else given, [])

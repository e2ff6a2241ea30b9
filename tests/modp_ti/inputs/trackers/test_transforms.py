"""What is particular to tracker `transforms`: keys of cameras and lenses, masks, panoramas, and what does not fit."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fields.geometry.se3 import exp_se3
from modp_ti.inputs.sources.distortion import COEFFICIENTS, colmap_lens
from tests.opening import opened, refusal
from tests.samples.filmed import OPENGL, Filmed
from tests.samples.kinds import write_sample


@pytest.fixture
def folder(filmed: Filmed, tmp_path: Path) -> Path:
    """A folder of images with a transforms.json and its points."""
    write_sample("transforms", tmp_path / "a", filmed)
    return tmp_path / "a"


def edit(folder: Path, change: Callable[[dict[str, Any]], object] = lambda data: None, **keys: object) -> None:
    """Change the file, and set keys of it, or take them out where they are None."""
    data = json.loads((folder / "transforms.json").read_text())
    change(data)
    data = {key: value for key, value in (data | keys).items() if value is not None}
    (folder / "transforms.json").write_text(json.dumps(data))


def each(change: Callable[[dict[str, Any]], object]) -> Callable[[dict[str, Any]], object]:
    return lambda data: [change(frame) for frame in data["frames"]]


def test_frames_come_in_natural_order_whatever_the_order_and_names_of_the_file(folder, filmed):
    """As Windows writes paths, without suffix, or from another folder."""
    edit(folder, lambda data: data["frames"].reverse(), ply_file_path=".\\points.ply")
    edit(folder, each(lambda frame: frame.update(file_path=".\\" + frame["file_path"].replace("/", "\\"))))
    assert [frame.name for frame in opened(folder).frames] == filmed.names
    edit(folder, each(lambda frame: frame.update(file_path="./train/" + frame["file_path"][9:-4])))
    tracker = opened(folder)
    for frame, view in zip(tracker.frames, filmed.views, strict=True):
        np.testing.assert_allclose(frame.T_camera_world, view.T_camera_world, atol=1e-9)
        assert len(frame.points) > 25


def test_intrinsics_of_a_frame_win_over_those_of_the_file(folder):
    edit(folder, lambda data: data["frames"][1].update(fl_x=311.0, cx=150.0))
    cameras = [frame.undistorter.camera for frame in opened(folder).frames]
    assert (cameras[1].fx, cameras[1].cx, cameras[1].fy) == (311.0, 150.0, 298.0)
    assert (cameras[0].fx, cameras[0].cx) == (300.0, 161.3)


def test_field_of_view_and_size_of_the_image_stand_in_for_what_is_missing(folder):
    angle = 2 * math.atan(0.5 * 320 / 300.0)
    edit(folder, fl_x=None, fl_y=None, cx=None, cy=None, w=None, h=None, camera_angle_x=angle)
    camera = opened(folder).frames[0].undistorter.camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (320, 240, 160, 120)
    assert (camera.fx, camera.fy) == (pytest.approx(300.0), pytest.approx(300.0))


def test_lens_keys_are_read(folder):
    k = {"k1": 0.1, "k2": -0.05, "k3": 0.01, "k4": -0.002, "p1": 0.003, "p2": 0.004}
    more = {"k5": 0.01, "k6": -0.02, "omega": 0.9, "sx1": 0.001, "k0": 0.003, "p0": 0.001, "s3": -0.001}
    edit(folder, **k)
    lens = opened(folder).frames[0].undistorter.distortion
    assert lens.numerator == (0.1, -0.05, 0.01, -0.002) and lens.tangential == (0.003, 0.004) and not lens.fisheye
    for model, names in COEFFICIENTS.items():
        edit(folder, camera_model=model, **more)
        values = [(k | more).get(name, 0.0) for name in names]
        assert opened(folder).frames[0].undistorter.distortion == colmap_lens(model, values)
    edit(folder, camera_model="OPENCV_FISHEYE")
    assert opened(folder).frames[0].undistorter.distortion.fisheye
    edit(folder, camera_model=None, is_fisheye=True)
    assert opened(folder).frames[0].undistorter.distortion.fisheye


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"w": 640, "h": 480}, "source.scale: 0.5"),
        ({"w": 240, "h": 320}, "lies on its side"),
        ({"w": 320.5}, "whole numbers"),
        ({"fl_x": "wide"}, "`fl_x` must be"),
        ({"fl_x": None, "fl_y": None}, "camera_angle_x"),
        ({"k1": float("nan")}, "`k1` must be"),
        ({"frames": []}, "no list of `frames`"),
        ({"frames": [{"transform_matrix": []}]}, "frame 0 has no `file_path`"),
        ({"camera_model": "EQUIRECTANGULAR"}, "source.panorama"),
        ({"camera_model": "BROWN"}, "BROWN"),
    ],
)
def test_what_does_not_fit_is_named(folder, keys, said):
    edit(folder, **keys)
    assert said in refusal(folder)


@pytest.mark.parametrize(
    "matrix",
    [
        np.diag([2.0, 2.0, 2.0, 1.0]).tolist(),
        np.diag([1.0, 1.0, -1.0, 1.0]).tolist(),
        np.where(np.eye(4, k=2) > 0, np.nan, np.eye(4)).tolist(),
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0.5, 1]],
        np.eye(3).tolist(),
        "identity",
        [[1, 2], [3]],
        None,
    ],
)
def test_a_pose_that_is_none_is_named_with_its_frame(folder, matrix):
    edit(folder, lambda data: data["frames"][3].update(transform_matrix=matrix))
    assert "frame images/view11.png" in refusal(folder)


def test_two_frames_of_one_image_are_an_error(folder):
    edit(folder, lambda data: data["frames"].append(data["frames"][2]))
    assert "are both the image view10.png" in refusal(folder)


def test_a_rounded_rotation_is_made_rigid(folder, filmed):
    edit(folder, each(lambda f: f.update(transform_matrix=np.round(f["transform_matrix"], 4).tolist()[:3])))
    for frame, view in zip(opened(folder).frames, filmed.views, strict=True):
        R = frame.T_camera_world[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(frame.T_camera_world, view.T_camera_world, atol=2e-3)


@pytest.mark.slow
def test_without_points_they_are_triangulated_on_the_surfaces_whatever_held_out_images_show(folder, filmed):
    """The world's surface is the plane z = 0; one pixel of parallax over the 25 degrees is 0.03 deep there."""
    edit(folder, ply_file_path="gone.ply")
    before = opened(folder, "source.holdout=3")
    assert any("gone.ply" in note for note in before.notes)
    for frame in before.frames:
        z = frame.points.xyz[:, 2]
        assert len(z) >= 50, "held-out frames get the points that they see"
        assert abs(np.median(z)) < 0.004 and np.median(np.abs(z)) < 0.02 and np.percentile(np.abs(z), 90) < 0.1
    # The held-out views shifted by a pixel: their features stay, what they would say of depth does not.
    for name in filmed.names[::3]:
        file = str(folder / "images" / name)
        cv2.imwrite(file, np.roll(np.asarray(cv2.imread(file)), 1, axis=1))
    after = opened(folder, "source.holdout=3")
    places = [{tuple(x) for frame in tracker.frames for x in frame.points.xyz.round(9)} for tracker in (before, after)]
    assert len(places[0]) > 150
    # Which features are joined may depend on held-out views; where two or more others agree on a point, it stays.
    assert len(places[0] & places[1]) > 0.7 * len(places[0])


def test_of_a_single_image_there_are_no_points(folder):
    edit(folder, ply_file_path=None)
    (frame,) = opened(folder, "source.start=3", "source.stop=4")
    assert len(frame.points) == 0


@pytest.mark.parametrize(("width", "height"), [(160, 120), (160, 160)])
def test_images_of_several_cameras_get_the_longer_side_of_the_first(folder, filmed, width, height):
    whole = list(opened(folder))
    file = str(folder / "images" / filmed.names[1])
    cv2.imwrite(file, cv2.resize(np.asarray(cv2.imread(file)), (width, height), interpolation=cv2.INTER_AREA))
    x, y = width / 320, height / 240
    (fx, _, cx), (_, fy, cy), _ = filmed.K.tolist()
    camera = {"w": width, "h": height, "fl_x": x * fx, "fl_y": y * fy, "cx": x * cx, "cy": y * cy}
    edit(folder, lambda data: data["frames"][1].update(camera))
    tracker = opened(folder)
    assert any("2 sizes" in note for note in tracker.notes)
    assert tracker.largest == (320, 320 * height // width)
    for i, (frame, before) in enumerate(zip(tracker, whole, strict=True)):
        assert frame.image.shape[:2] == ((320 * height // width if i == 1 else 240), 320)
        scale = (1, frame.image.shape[0] / 240)
        np.testing.assert_allclose(frame.points.pixels, before.points.pixels * scale, atol=1e-9)
        assert frame.image.shape != before.image.shape or np.abs(frame.image - before.image).mean() < 0.05


def test_the_faces_of_a_panorama_lie_at_its_pose(tmp_path):
    (tmp_path / "images").mkdir()
    poses = [exp_se3([0.1 * i, 0.2, 0.3, 0.3, -0.2 * i, 0.1]) for i in range(4)]
    frames = []
    for i, T in enumerate(poses):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), np.full((32, 64, 3), 90, np.uint8))
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": (np.linalg.inv(T) @ OPENGL).tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_model": "EQUIRECTANGULAR", "frames": frames}))
    panorama = "panorama: {projection: equirectangular, faces: 3}"
    scene = f"source: {{path: images, holdout: 2, start: 1, {panorama}}}\ntracker: {{kind: transforms}}\noutput: out\n"
    (tmp_path / "scene.yaml").write_text(scene)
    tracker = opened(tmp_path)
    assert [frame.name for frame in tracker.frames] == [f"{i}-face{n}.png" for i in (1, 2, 3) for n in range(3)]
    for place, frame in enumerate(tracker):
        T = poses[1 + place // 3]
        turned = 2 * np.pi / 3 * (place % 3)
        np.testing.assert_allclose(frame.T_camera_world[:3, :3].T @ frame.T_camera_world[:3, 3], T[:3, :3].T @ T[:3, 3])
        np.testing.assert_allclose(frame.T_camera_world[2, :3], [np.sin(turned), 0, np.cos(turned)] @ T[:3, :3])
        assert (frame.views, frame.held_out) == (3, place // 3 != 1)


@pytest.mark.parametrize("place", ["masks", "images"])
def test_masks_that_the_file_names_are_read_as_those_of_a_folder_and_are_no_images(folder, filmed, place):
    """One frame has none. Depth maps that it names are no images either."""
    mask = np.zeros(filmed.size[::-1], np.uint8)
    mask[80:] = 255
    for inside in (place, "same"):
        (folder / inside).mkdir(exist_ok=True)
    for name in filmed.names:
        cv2.imwrite(str(folder / "same" / name), mask)
    by_folder = list(opened(folder, f"source.masks={folder / 'same'}"))
    for name in filmed.names[1:]:
        for kind in ("valid", "far"):
            cv2.imwrite(str(folder / place / f"{name[:-4]}_{kind}.png"), mask)

    def name_masks(data) -> None:
        for frame in data["frames"][1:]:
            stem = frame["file_path"][len("images/") : -4]
            frame |= {"mask_path": f"./{place}/{stem}_valid.png", "depth_file_path": f"{place}\\{stem}_far.png"}

    edit(folder, name_masks)
    tracker = opened(folder)
    assert tracker.notes == []
    first, *frames = tracker
    assert first.mask is None
    for frame, expected in zip(frames, by_folder[1:], strict=True):
        np.testing.assert_array_equal(frame.mask, expected.mask)
        np.testing.assert_array_equal(frame.points.pixels, expected.points.pixels)
    edit(folder, lambda data: data["frames"][1].update(mask_path="masks/gone.png"))
    assert "gone.png" in refusal(folder)

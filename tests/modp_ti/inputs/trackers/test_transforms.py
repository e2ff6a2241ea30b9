"""Tracker `transforms` reads the files of instant-ngp and nerfstudio, and names what does not fit."""

from __future__ import annotations

import json
import math
import shutil

import cv2
import numpy as np
import pytest

from fields.geometry.se3 import exp_se3
from modp_ti.config.settings import SourceSettings
from modp_ti.files.errors import InputError
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.readers.transforms import TransformsSettings
from modp_ti.inputs.sources.distortion import COEFFICIENTS, colmap_lens
from tests.opening import opened_with

pytestmark = pytest.mark.slow


def opened(scene, file=None, progress=None, **source):
    return opened_with(SourceSettings(path=scene.folder, **source), TransformsSettings(path=file), progress)


def failure(scene, file=None, **source) -> str:
    with pytest.raises(InputError) as caught:
        opened(scene, file, **source)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def with_cloud(plane_scene):
    """The scene with points in a PLY file, so that nothing has to be triangulated."""
    rng = np.random.default_rng(3)
    xyz = np.c_[rng.uniform(-1.8, 1.8, (50, 2)), np.zeros(50)]
    rows = "\n".join(" ".join(map(repr, row)) for row in xyz.tolist())
    header = f"ply\nformat ascii 1.0\nelement vertex {len(xyz)}\n" + "".join(
        f"property double {axis}\n" for axis in "xyz"
    )
    (plane_scene.folder.parent / "points.ply").write_text(f"{header}end_header\n{rows}\n")
    plane_scene.write_transforms(ply_file_path="points.ply")
    return plane_scene


def edited(scene, change) -> None:
    file = scene.folder.parent / "transforms.json"
    data = json.loads(file.read_text())
    change(data)
    file.write_text(json.dumps(data))


def test_poses_come_in_opencv_axes_and_natural_order_whatever_the_order_of_the_file(with_cloud):
    edited(with_cloud, lambda data: data["frames"].reverse())
    tracker = opened(with_cloud, scale=0.5, holdout=3)
    assert isinstance(tracker, Tracker)
    assert tracker.notes == []
    frames = list(tracker)
    assert [frame.name for frame in frames] == [f"view{i}.png" for i in range(8, 15)]
    assert [frame.held_out for frame in frames] == [True, False, False, True, False, False, True]
    for frame, T in zip(frames, with_cloud.T_camera_world, strict=True):
        np.testing.assert_allclose(frame.T_camera_world, T, atol=1e-12)
        np.testing.assert_allclose(frame.camera.matrix()[:2], with_cloud.K[:2] / 2)
        p = frame.points.xyz @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(frame.camera.project(p), frame.points.pixels, atol=1e-9)
        assert len(frame.points) > 25


def test_frames_without_image_file_are_skipped_with_a_count(with_cloud):
    def add_absent(data):
        data["frames"] += [{**data["frames"][0], "file_path": f"images/gone{i}.png"} for i in range(3)]

    edited(with_cloud, add_absent)
    shutil.copy(with_cloud.folder / "view8.png", with_cloud.folder / "unposed.png")
    tracker = opened(with_cloud)
    assert len(tracker) == 7
    assert tracker.notes == [
        f"3 frames of transforms.json are not in {with_cloud.folder}: skipped",
        "1 of 8 images have no pose in transforms.json: skipped (the first: unposed.png)",
    ]


def test_no_image_at_all_is_an_error(with_cloud):
    def rename(data):
        for i, entry in enumerate(data["frames"]):
            entry["file_path"] = f"images/gone{i}.png"

    edited(with_cloud, rename)
    message = failure(with_cloud)
    assert "none of its 7 frames is in" in message and "gone0.png" in message and "source.path" in message


def test_names_without_suffix_or_from_another_folder_are_found(with_cloud):
    def rename(data):
        for entry in data["frames"]:
            entry["file_path"] = "./train/" + entry["file_path"].removeprefix("images/").removesuffix(".png")

    edited(with_cloud, rename)
    assert len(opened(with_cloud)) == 7


def test_two_frames_of_one_image_are_an_error(with_cloud):
    edited(with_cloud, lambda data: data["frames"].append(data["frames"][2]))
    assert "frames 2 (images/view10.png) and 7 (images/view10.png) are both the image view10.png" in failure(with_cloud)


def test_intrinsics_of_a_frame_win_over_those_of_the_file(with_cloud):
    edited(with_cloud, lambda data: data["frames"][1].update(fl_x=311.0, cx=150.0))
    cameras = [frame.undistorter.camera for frame in opened(with_cloud).frames]
    assert (cameras[1].fx, cameras[1].cx, cameras[1].fy) == (311.0, 150.0, 298.0)
    assert (cameras[0].fx, cameras[0].cx) == (300.0, 161.3)


def test_field_of_view_and_size_of_the_image_stand_in_for_what_is_missing(with_cloud):
    angle = 2 * math.atan(0.5 * 320 / 300.0)
    with_cloud.write_transforms(
        ply_file_path="points.ply",
        fl_x=None,
        fl_y=None,
        cx=None,
        cy=None,
        w=None,
        h=None,
        camera_angle_x=angle,
    )
    camera = opened(with_cloud).frames[0].undistorter.camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (320, 240, 160, 120)
    assert camera.fx == pytest.approx(300.0)
    assert camera.fy == pytest.approx(300.0)


def test_lens_keys_are_read(with_cloud):
    k = {"k1": 0.1, "k2": -0.05, "k3": 0.01, "k4": -0.002, "p1": 0.003, "p2": 0.004}
    with_cloud.write_transforms(ply_file_path="points.ply", **k)
    lens = opened(with_cloud).frames[0].undistorter.distortion
    assert lens.numerator == (0.1, -0.05, 0.01, -0.002) and lens.tangential == (0.003, 0.004) and not lens.fisheye
    with_cloud.write_transforms(ply_file_path="points.ply", camera_model="OPENCV_FISHEYE", **k)
    assert opened(with_cloud).frames[0].undistorter.distortion.fisheye
    with_cloud.write_transforms(ply_file_path="points.ply", is_fisheye=True, **k)
    assert opened(with_cloud).frames[0].undistorter.distortion.fisheye
    more = {"k5": 0.01, "k6": -0.02, "omega": 0.9, "sx1": 0.001, "k0": 0.003, "p0": 0.001, "s3": -0.001}
    for model, names in COEFFICIENTS.items():
        with_cloud.write_transforms(ply_file_path="points.ply", camera_model=model, **k, **more)
        values = [(k | more).get(name, 0.0) for name in names]
        assert opened(with_cloud).frames[0].undistorter.distortion == colmap_lens(model, values)
    with_cloud.write_transforms(ply_file_path="points.ply", camera_model="EQUIRECTANGULAR")
    assert "source.panorama" in failure(with_cloud)


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (
            {"w": 640, "h": 480},
            ["view8.png is 320x240", "640x480", "at 0.5 of the size", "source.scale: 0.5"],
        ),
        ({"w": 240, "h": 320}, ["320x240", "240x320", "lies on its side"]),
        ({"w": 320.5}, ["whole numbers"]),
        ({"fl_x": "wide"}, ["`fl_x` must be a number", '"wide"']),
        ({"fl_x": -3}, ["no focal length"]),
        ({"fl_x": None, "fl_y": None}, ["no focal length", "camera_angle_x"]),
        ({"k1": float("nan")}, ["`k1` must be a number"]),
        ({"frames": []}, ["no list of `frames`"]),
        ({"frames": [{"transform_matrix": []}]}, ["frame 0 has no `file_path`"]),
    ],
)
def test_what_does_not_fit_is_named(with_cloud, change, parts):
    with_cloud.write_transforms(ply_file_path="points.ply", **change)
    message = failure(with_cloud)
    for part in parts:
        assert part in message


MATRIX = np.eye(4)


@pytest.mark.parametrize(
    ("matrix", "part"),
    [
        (np.diag([2.0, 2.0, 2.0, 1.0]), "no rigid motion"),
        (MATRIX + 0.2 * np.eye(4, k=1) * [[1], [0], [0], [0]], "no rigid motion"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "mirrors"),
        (np.where(np.eye(4, k=2) > 0, np.nan, MATRIX), "NaN"),
        (np.vstack([MATRIX[:3], [0, 0, 0.5, 1]]), "last row"),
        (np.eye(3), "4 rows of 4 numbers"),
        ("identity", "4 rows of 4 numbers"),
        ([[1, 2], [3]], "4 rows of 4 numbers"),
        (None, "4 rows of 4 numbers"),
    ],
)
def test_pose_that_is_none_is_named_with_its_frame(with_cloud, matrix, part):
    value = matrix.tolist() if isinstance(matrix, np.ndarray) else matrix
    edited(with_cloud, lambda data: data["frames"][3].update(transform_matrix=value))
    message = failure(with_cloud)
    assert "frame images/view11.png" in message and part in message


def test_rounded_rotation_is_made_rigid(with_cloud):
    def rounded(data):
        for entry in data["frames"]:
            entry["transform_matrix"] = np.round(entry["transform_matrix"], 4).tolist()[:3]

    edited(with_cloud, rounded)
    for frame, T in zip(opened(with_cloud).frames, with_cloud.T_camera_world, strict=True):
        R = frame.T_camera_world[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(frame.T_camera_world, T, atol=2e-3)


def test_file_is_found_beside_the_images_in_a_given_folder_or_by_name(with_cloud, tmp_path):
    file = with_cloud.folder.parent / "transforms.json"
    assert len(opened(with_cloud, file)) == 7
    assert len(opened(with_cloud, file.parent)) == 7
    assert "no such file (tracker.path)" in failure(with_cloud, tmp_path / "gone.json")
    file.unlink()
    assert "set tracker.path" in failure(with_cloud)


@pytest.mark.parametrize(("text", "part"), [("{\n\n oops", "transforms.json:3: not valid JSON"), ("[]", "no list of")])
def test_file_that_is_no_transforms_json_is_named(with_cloud, text, part):
    (with_cloud.folder.parent / "transforms.json").write_text(text)
    assert part in failure(with_cloud)


def test_without_points_they_are_triangulated_on_the_surfaces(plane_scene):
    plane_scene.write_transforms()
    calls = []
    tracker = opened(plane_scene, progress=lambda *call: calls.append(call))
    frames = list(tracker)
    for frame in frames:
        assert len(frame.points) >= 100
        # the world's surface is the plane z = 0; one pixel of parallax over the 25 degrees is 0.03 deep there
        z = frame.points.xyz[:, 2]
        assert abs(np.median(z)) < 0.004
        assert np.median(np.abs(z)) < 0.02
        assert np.percentile(np.abs(z), 90) < 0.1
    assert calls[0][1:] == (1, 7)
    assert all(done <= total for _, done, total in calls)
    assert calls[-1][1] == calls[-1][2]


def test_triangulation_gives_the_same_points_bit_for_bit(plane_scene):
    plane_scene.write_transforms()
    for one, other in zip(opened(plane_scene).frames, opened(plane_scene).frames, strict=True):
        assert np.array_equal(one.points.xyz, other.points.xyz)
        assert np.array_equal(one.points.pixels, other.points.pixels)
        assert np.array_equal(one.points.ids, other.points.ids)


def test_points_named_but_not_there_are_triangulated_with_a_note(plane_scene):
    plane_scene.write_transforms(ply_file_path="gone.ply")
    tracker = opened(plane_scene)
    assert tracker.notes == ["transforms.json names points that are not there (gone.ply): triangulated instead"]
    assert len(tracker.frames[3].points) >= 100


def test_of_a_single_image_there_are_no_points(plane_scene):
    plane_scene.write_transforms()
    (frame,) = opened(plane_scene, start=3, stop=4)
    assert len(frame.points) == 0


def test_held_out_images_do_not_decide_where_a_point_lies(plane_scene):
    plane_scene.write_transforms()
    before = opened(plane_scene, holdout=3)
    # The held-out views shifted by a pixel: their features stay, what they would say of depth does not.
    for name in ("view8.png", "view11.png", "view14.png"):
        file = str(plane_scene.folder / name)
        cv2.imwrite(file, np.roll(cv2.imread(file), 1, axis=1))
    after = opened(plane_scene, holdout=3)
    places = [{tuple(x) for frame in tracker.frames for x in frame.points.xyz.round(9)} for tracker in (before, after)]
    assert len(places[0]) > 150
    for tracker in (before, after):
        assert len(tracker.frames[3].points) >= 50, "held-out frames are told which of the points they see"
    # Which features are joined may depend on held-out views; where two or more others agree on a point, it
    # stays put.
    assert len(places[0] & places[1]) > 0.7 * len(places[0])


def test_paths_of_windows_are_read(with_cloud):
    with_cloud.write_transforms(ply_file_path=".\\points.ply")
    file = with_cloud.folder.parent / "transforms.json"
    data = json.loads(file.read_text())
    for frame in data["frames"]:
        frame["file_path"] = ".\\" + frame["file_path"].replace("/", "\\")
    file.write_text(json.dumps(data))
    tracker = opened_with(SourceSettings(path=with_cloud.folder), TransformsSettings())
    assert [frame.name for frame in tracker.frames] == with_cloud.names
    assert all(len(frame.points) for frame in tracker.frames)


def with_another_camera(scene, width: int, height: int) -> None:
    """Image 1 is of a second camera with another size, whose keys are those of the frame."""
    image = cv2.imread(str(scene.folder / scene.names[1]))
    cv2.imwrite(str(scene.folder / scene.names[1]), cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))
    file = scene.write_transforms(ply_file_path="points.ply")
    data = json.loads(file.read_text())
    x, y = width / scene.size[0], height / scene.size[1]
    (fx, _, cx), (_, fy, cy), _ = scene.K.tolist()
    data["frames"][1] |= {"w": width, "h": height, "fl_x": x * fx, "fl_y": y * fy, "cx": x * cx, "cy": y * cy}
    file.write_text(json.dumps(data))


def test_images_of_several_sizes_are_delivered_at_that_of_the_first(with_cloud):
    whole = list(opened_with(SourceSettings(path=with_cloud.folder), TransformsSettings()))
    with_another_camera(with_cloud, 160, 120)
    tracker = opened_with(SourceSettings(path=with_cloud.folder), TransformsSettings())
    assert "the images have 2 sizes: they are mapped at 320x240" in tracker.notes
    for frame, before in zip(tracker, whole, strict=True):
        assert frame.image.shape == before.image.shape
        np.testing.assert_allclose(frame.camera.matrix(), before.camera.matrix())
        np.testing.assert_allclose(frame.points.pixels, before.points.pixels, atol=1e-9)
        assert np.abs(frame.image - before.image).mean() < 0.05


def test_an_image_of_another_shape_keeps_it_and_gets_the_longer_side_of_the_first(with_cloud):
    whole = list(opened_with(SourceSettings(path=with_cloud.folder), TransformsSettings()))
    with_another_camera(with_cloud, 160, 160)
    tracker = opened_with(SourceSettings(path=with_cloud.folder), TransformsSettings())
    assert "the images have 2 sizes: they are mapped at 320x240, 320x320" in tracker.notes
    assert tracker.largest == (320, 320)
    frames = list(tracker)
    assert [frame.image.shape[:2] for frame in frames] == [(240, 320), (320, 320), *[(240, 320)] * 5]
    np.testing.assert_allclose(frames[1].points.pixels, whole[1].points.pixels * (1, 320 / 240), atol=1e-9)


def test_the_faces_of_a_panorama_lie_at_its_pose(tmp_path):
    (tmp_path / "images").mkdir()
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = [exp_se3([0.1 * i, 0.2, 0.3, 0.3, -0.2 * i, 0.1]) for i in range(4)]
    frames = []
    for i, T in enumerate(poses):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), np.full((32, 64, 3), 90, np.uint8))
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": (np.linalg.inv(T) @ flip).tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_model": "EQUIRECTANGULAR", "frames": frames}))
    panorama = {"projection": "equirectangular", "faces": 3}
    source = SourceSettings.model_validate(
        {"path": tmp_path / "images", "holdout": 2, "start": 1, "panorama": panorama}
    )
    tracker = opened_with(source, TransformsSettings())
    assert [frame.name for frame in tracker.frames] == [f"{i}-face{n}.png" for i in (1, 2, 3) for n in range(3)]
    for place, frame in enumerate(tracker):
        T = poses[1 + place // 3]
        turned = 2 * np.pi / 3 * (place % 3)
        np.testing.assert_allclose(frame.T_camera_world[:3, :3].T @ frame.T_camera_world[:3, 3], T[:3, :3].T @ T[:3, 3])
        np.testing.assert_allclose(frame.T_camera_world[2, :3], [np.sin(turned), 0, np.cos(turned)] @ T[:3, :3])
        assert (frame.views, frame.held_out) == (3, place // 3 != 1)


@pytest.mark.parametrize("place", ["masks", "images"])
def test_masks_that_the_file_names_are_read_as_those_of_a_folder_and_are_no_images(with_cloud, place):
    """One frame has none. Depth maps that it names are no images either."""
    root = with_cloud.folder.parent
    width, height = with_cloud.size
    mask = np.zeros((height, width), np.uint8)
    mask[height // 3 :] = 255
    for folder in (place, "same"):
        (root / folder).mkdir(exist_ok=True)
    for name in with_cloud.names:
        stem = name.rpartition(".")[0]
        cv2.imwrite(str(root / place / f"{stem}_valid.png"), mask)
        cv2.imwrite(str(root / place / f"{stem}_far.png"), mask)
        cv2.imwrite(str(root / "same" / name), mask)

    def named(data) -> None:
        for frame in data["frames"][1:]:
            stem = frame["file_path"].rpartition("/")[2].rpartition(".")[0]
            frame |= {"mask_path": f"./{place}/{stem}_valid.png", "depth_file_path": f"{place}\\{stem}_far.png"}

    by_folder = list(opened(with_cloud, masks=root / "same"))
    edited(with_cloud, named)
    if place == "images":
        (root / "images" / f"{with_cloud.names[0].rpartition('.')[0]}_valid.png").unlink()
        (root / "images" / f"{with_cloud.names[0].rpartition('.')[0]}_far.png").unlink()
    tracker = opened(with_cloud)
    assert tracker.notes == []
    first, *frames = tracker
    assert first.mask is None
    for frame, expected in zip(frames, by_folder[1:], strict=True):
        np.testing.assert_array_equal(frame.mask, expected.mask)
        np.testing.assert_array_equal(frame.points.pixels, expected.points.pixels)
    edited(with_cloud, lambda data: data["frames"][1].update(mask_path="masks/gone.png"))
    assert "gone.png" in failure(with_cloud)

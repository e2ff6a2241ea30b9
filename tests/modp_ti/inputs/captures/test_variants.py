"""What differs between versions of an app or parts of a data set: older keys, other folders, what is missing."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modp_ti.config.bare_recording import recorded_scene
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.source_settings import SourceSettings
from modp_ti.inputs.sources.distortion import lens_of_model
from tests.opening import assert_poses, off_pixels, read_capture
from tests.samples.captures import KITTI_OFFSET, WRITERS, exr_file, lzfse_stored, zipped


def changed(file: Path, change) -> None:
    """Change a JSON file in place."""
    data = json.loads(file.read_text())
    change(data)
    file.write_text(json.dumps(data))


def test_record3d_of_older_keys_has_one_camera_and_times_by_the_rate(views, tmp_path):
    WRITERS["record3d"](tmp_path / "room", views)
    for key in ("perFrameIntrinsicCoeffs", "frameTimestamps", "dw", "dh", "cameraType"):
        changed(tmp_path / "room/metadata", lambda data, key=key: data.pop(key))
    capture = read_capture(tmp_path / "room", "record3d")
    assert_poses(capture.frames, views)
    assert [frame.time for frame in capture.frames] == [n / 60 for n in range(7)]
    np.testing.assert_allclose(capture.frames[3].camera.matrix(), views[0].K)


def test_record3d_depth_without_a_stated_size_is_upright(views, tmp_path, opened):
    pytest.importorskip("lzfse")
    WRITERS["record3d"](tmp_path / "room", views[:2])
    changed(tmp_path / "room/metadata", lambda data: (data.pop("dw"), data.pop("dh")))
    depths = [view.depth(np.diag([192 / 320, 256 / 240, 1]) @ view.K, (192, 256)) for view in views[:2]]
    for n, depth in enumerate(depths):
        (tmp_path / f"room/rgbd/{n}.depth").write_bytes(lzfse_stored(depth.astype("<f4").tobytes()))
        (tmp_path / f"room/rgbd/{n}.conf").unlink()
    frames = opened(tmp_path / "room", "record3d", max_depth=20).frames
    assert all(len(frame.points) > 300 and np.abs(frame.points.xyz[:, 2]).max() < 1e-4 for frame in frames)


def test_record3d_without_lzfse_is_triangulated_and_says_what_to_install(views, tmp_path, opened, monkeypatch):
    monkeypatch.setitem(sys.modules, "lzfse", None)
    WRITERS["record3d"](tmp_path / "room", views[:4])
    tracker = opened(tmp_path / "room", "record3d")
    assert any("pip install 'modp-ti[record3d]': points are triangulated instead" in note for note in tracker.notes)
    assert all(len(frame.points) > 50 for frame in tracker.frames)


def test_record3d_reads_what_lzfse_has_packed(views, tmp_path, opened):
    lzfse = pytest.importorskip("lzfse")
    WRITERS["record3d"](tmp_path / "room", views[:2])
    plain = opened(tmp_path / "room", "record3d").frames
    for file in (*tmp_path.glob("room/rgbd/*.depth"), *tmp_path.glob("room/rgbd/*.conf")):
        packed = lzfse.compress(lzfse.decompress(file.read_bytes()))
        assert packed[:4] in (b"bvx2", b"bvxn")
        file.write_bytes(packed)
    for a, b in zip(plain, opened(tmp_path / "room", "record3d").frames, strict=True):
        np.testing.assert_array_equal(a.points.xyz, b.points.xyz)


@pytest.mark.parametrize("channel", ["R", "Y"])
def test_record3d_exported_as_exr_and_rgb(views, tmp_path, opened, channel):
    WRITERS["record3d"](tmp_path / "room", views[:3])
    (tmp_path / "room/metadata").rename(tmp_path / "room/metadata.json")
    (tmp_path / "room/depth").mkdir()
    for n, view in enumerate(views[:3]):
        (tmp_path / f"room/rgbd/{n}.depth").unlink()
        (tmp_path / f"room/rgbd/{n}.conf").unlink()
        (tmp_path / f"room/depth/{n}.exr").write_bytes(exr_file(view.depth_map(), channel))
    (tmp_path / "room/rgbd").rename(tmp_path / "room/rgb")
    tracker = opened(tmp_path / "room", "record3d", max_depth=20)
    assert_poses(tracker.frames, views[:3])
    assert all(len(f.points) > 300 and np.abs(f.points.xyz[:, 2]).max() < 1e-4 for f in tracker.frames)
    data = exr_file(views[0].depth_map())
    for damaged in (b"", data[:300], data.replace(b"chlist", b"string"), b"\0" * 5000):
        (tmp_path / "room/depth/1.exr").write_bytes(damaged)
        with pytest.raises(InputError, match=r"1.exr"):
            opened(tmp_path / "room", "record3d")


def test_record3d_with_exchanged_sides_goes_by_the_picture(views, tmp_path):
    WRITERS["record3d"](tmp_path / "room", views[:2])
    changed(tmp_path / "room/metadata", lambda data: data.update(w=240, h=320))
    camera = read_capture(tmp_path / "room", "record3d").frames[0].camera
    assert (camera.width, camera.height) == (320, 240)
    np.testing.assert_allclose(camera.matrix(), views[0].K)


def test_stray_scanner_of_older_tables_has_one_camera(views, tmp_path):
    WRITERS["stray_scanner"](tmp_path / "room", views)
    table = tmp_path / "room/odometry.csv"
    rows = [",".join(line.split(",")[:9]) for line in table.read_text().splitlines()]
    table.write_text("\n".join(rows) + "\n")
    K = np.diag([6, 6, 1]) @ views[0].K
    (tmp_path / "room/camera_matrix.csv").write_text("\n".join(",".join(map(str, row)) for row in K) + "\n")
    capture = read_capture(tmp_path / "room", "stray_scanner")
    assert_poses(capture.frames, views)
    np.testing.assert_allclose(capture.frames[2].camera.matrix(), K)


def test_rows_of_stray_scanner_without_a_picture_are_told(views, tmp_path, opened):
    WRITERS["stray_scanner"](tmp_path / "room", views)
    with (tmp_path / "room/odometry.csv").open("a") as file:
        file.write("501, 000007, 0, 0, 0, 0, 0, 0, 1, 1600, 1600, 960, 720, , \n")
    tracker = opened(tmp_path / "room", "stray_scanner")
    assert_poses(tracker.frames, views)
    assert "rgb.mp4 has 7 frames, odometry.csv 8 rows: the last rows are left out" in tracker.notes


def test_polycam_uses_corrected_poses_and_masks_the_border(views, tmp_path, opened):
    WRITERS["polycam"](tmp_path / "room", views)
    frames = tmp_path / "room/keyframes"
    shutil.copytree(frames / "images", frames / "corrected_images")
    shutil.copytree(frames / "cameras", frames / "corrected_cameras")
    for file in (frames / "cameras").iterdir():
        changed(file, lambda data: data.update(t_03=data["t_03"] + 1.0))
    sorted((frames / "corrected_cameras").iterdir())[2].unlink()
    tracker = opened(tmp_path / "room", "polycam", {"scale": 1})
    assert_poses(tracker.frames, [*views[:2], *views[3:]])
    assert any("1 of its 7 frames are not in keyframes/corrected_images" in note for note in tracker.notes)
    frame = next(iter(tracker))
    assert frame.mask is not None and not frame.mask[:15].any() and not frame.mask[:, -15:].any()
    assert frame.mask[15:-15, 15:-15].all()


def test_polycam_without_confidence_uses_all_depths(views, tmp_path, opened):
    WRITERS["polycam"](tmp_path / "room", views[:2])
    shutil.rmtree(tmp_path / "room/keyframes/confidence")
    x = np.concatenate([f.points.pixels[:, 0] for f in opened(tmp_path / "room", "polycam", max_depth=600).frames])
    assert x.min() < 30


def test_images_of_euroc_before_the_truth_begins_are_skipped(views, tmp_path, opened):
    WRITERS["euroc"](tmp_path / "room", views[:5])
    truth = tmp_path / "room/mav0/state_groundtruth_estimate0/data.csv"
    lines = truth.read_text().splitlines()
    truth.write_text("\n".join([lines[0], *lines[5:]]) + "\n")
    tracker = opened(tmp_path / "room", "euroc")
    assert_poses(tracker.frames, views[2:5])
    assert any("2 of 5 images have no pose" in note for note in tracker.notes)


@pytest.mark.parametrize(
    ("model", "k"),
    [
        ("equidistant", [0.1, 0.2, 0.3, 0.4]),
        ("radial-tangential", [0.1, 0.2, 0.3, 0.4]),
        ("radial-tangential", [-0.2, 0.05, 0.001, -0.002, 0.01]),
    ],
)
def test_the_lens_of_euroc_is_that_of_its_model(views, tmp_path, model, k):
    """The models themselves are compared with OpenCV's in the tests of bags."""
    WRITERS["euroc"](tmp_path / "room", views[:2])
    sensor = tmp_path / "room/mav0/cam0/sensor.yaml"
    text = sensor.read_text().replace("radial-tangential", model).replace("[0.0, 0.0, 0.0, 0.0]", str(k))
    sensor.write_text(text.replace("%YAML:1.0\n", "# the original has no first line of OpenCV's\n"))
    assert read_capture(tmp_path / "room", "euroc").frames[0].lens == lens_of_model(model, k, "")


def test_kitti_poses_are_found_two_folders_up_and_grey_is_used_without_colour(views, tmp_path):
    folder = tmp_path / "dataset/sequences/05"
    WRITERS["kitti"](folder, views)
    (tmp_path / "dataset/poses").mkdir()
    (folder / "poses.txt").rename(tmp_path / "dataset/poses/05.txt")
    assert_poses(read_capture(folder, "kitti").frames, views)
    (folder / "image_2").rename(folder / "image_0")
    for frame, view in zip(read_capture(folder, "kitti").frames, views, strict=True):
        left = np.linalg.inv(view.T_world_camera) @ view.T_world_camera[:, 3]
        offset = frame.T_camera_world @ view.T_world_camera @ [*KITTI_OFFSET, 1.0]
        np.testing.assert_allclose(offset, left, atol=1e-6)  # the colour camera's view of camera 0 is its centre


def test_frames_that_scannet_has_lost_are_skipped(views, tmp_path, opened):
    WRITERS["scannet"](tmp_path / "room", views)
    (tmp_path / "room/pose/2.txt").write_text("-inf -inf -inf -inf\n" * 4)
    (tmp_path / "room/pose/4.txt").unlink()
    tracker = opened(tmp_path / "room", "scannet")
    assert_poses(tracker.frames, [views[n] for n in (0, 1, 3, 5, 6)])
    assert "2 of 7 images have no pose in pose: skipped (the first: color/2.jpg)" in tracker.notes


def test_images_of_arkitscenes_without_intrinsics_or_a_pose_are_left_out(views, tmp_path, opened):
    WRITERS["arkitscenes"](tmp_path / "room", views)
    sorted((tmp_path / "room/lowres_wide_intrinsics").iterdir())[3].unlink()
    lines = (tmp_path / "room/lowres_wide.traj").read_text().splitlines()
    (tmp_path / "room/lowres_wide.traj").write_text("\n".join(lines[:6]) + "\n")
    tracker = opened(tmp_path / "room", "arkitscenes")
    assert_poses(tracker.frames, [views[n] for n in (0, 1, 2, 4, 5)])
    assert "1 of its 7 images have no intrinsics: left out" in tracker.notes


def test_a_turned_picture_turns_pose_and_points_with_it(views, tmp_path, opened):
    """EXIF asks for a quarter turn, which the camera in the file does not know of."""
    from PIL import Image

    WRITERS["scanner_app"](tmp_path / "app", views[:2])
    straight = opened(tmp_path / "app", "scanner_app").frames
    for file in tmp_path.glob("app/frame_*.jpg"):
        image = Image.open(file)
        exif = image.getexif()
        exif[0x0112] = 6
        image.save(file, exif=exif, quality=98)
    for a, b in zip(straight, opened(tmp_path / "app", "scanner_app").frames, strict=True):
        assert (b.undistorter.camera.width, b.undistorter.camera.height) == (240, 320)
        relative = b.T_camera_world @ np.linalg.inv(a.T_camera_world)
        np.testing.assert_allclose(Rotation.from_matrix(relative[:3, :3]).as_rotvec(), [0, 0, np.pi / 2], atol=1e-6)
        np.testing.assert_allclose(a.points.xyz, b.points.xyz)
        assert off_pixels(b).max() < 1e-6


def test_an_archive_of_something_else_is_told(tmp_path):
    (tmp_path / "things").mkdir()
    (tmp_path / "things/a.txt").write_text("hello")
    file = zipped(tmp_path / "things", tmp_path / "things.zip")
    with pytest.raises(InputError, match=r"things.zip: is no capture of a known app; unpack it"):
        recorded_scene(file)
    file.write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(InputError, match=r"things.zip: is no zip archive, or is cut off: copy it again"):
        recorded_scene(file)


@pytest.mark.parametrize("kind", ["euroc", "kitti"])
def test_a_sequence_without_poses_is_tracked_by_its_images(kind, views, tmp_path, opened):
    WRITERS[kind](tmp_path / "room", views[:3])
    for truth in ("poses.txt", "mav0/state_groundtruth_estimate0/data.csv"):
        (tmp_path / "room" / truth).unlink(missing_ok=True)
    images = open_source(SourceSettings(path=tmp_path / "room"))
    assert len(images) == 3 and images.intrinsics is not None
    np.testing.assert_allclose(images.intrinsics.camera.matrix(), views[0].K, atol=1e-6)
    with pytest.raises(InputError, match=r"tracker\.kind=klt"):
        opened(tmp_path / "room", kind)


@pytest.mark.parametrize("folder", ["mocap0", "vicon0"])
def test_poses_of_markers_are_taken_to_the_body_that_carries_them(folder, views, tmp_path):
    """In TUM-VI's layout they lie in mocap0. The markers are turned and moved on the body."""
    WRITERS["euroc"](tmp_path / "room", views)
    top = tmp_path / "room/mav0"
    (top / "state_groundtruth_estimate0").rename(top / folder)
    T_body_markers = np.eye(4)
    T_body_markers[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.2, 0.5]).as_matrix()
    T_body_markers[:3, 3] = (0.1, 0.2, -0.3)
    lines = (top / folder / "data.csv").read_text().splitlines()
    rows = np.array([[float(word) for word in line.split(",")[1:8]] for line in lines[1:]])
    turns = Rotation.from_quat(rows[:, [4, 5, 6, 3]])
    x, y, z, w = (turns * Rotation.from_matrix(T_body_markers[:3, :3])).as_quat().T
    there = np.column_stack([rows[:, :3] + turns.apply(T_body_markers[:3, 3]), w, x, y, z])
    moved = [
        f"{line.split(',')[0]}," + ",".join(map(repr, row)) for line, row in zip(lines[1:], there.tolist(), strict=True)
    ]
    (top / folder / "data.csv").write_text("\n".join([lines[0], *moved]) + "\n")
    numbers = ", ".join(map(repr, T_body_markers.ravel().tolist()))
    (top / folder / "sensor.yaml").write_text(f"%YAML:1.0\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers}]\n")
    assert_poses(read_capture(tmp_path / "room", "euroc").frames, views)

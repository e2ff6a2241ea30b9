"""Captures of real apps and data sets: depths and images agree with the poses. Skipped where the data is not there."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest

from modp_ti.inputs.depth_maps import read_millimetres
from modp_ti.inputs.inspection.conventions import STATED
from modp_ti.inputs.inspection.geometry import measure_geometry
from modp_ti.inputs.inspection.survey import survey
from tests.opening import read_capture

pytestmark = pytest.mark.real_data


def test_points_of_3d_scanner_app_lie_where_another_frame_measures_them(shared_data, opened):
    folder = shared_data("captures") / "3dscannerapp"
    frames = opened(folder, "scanner_app", {"scale": 1}).frames
    capture = read_capture(folder, "scanner_app")
    assert len(frames) == 4 and all(len(frame.points) > 300 for frame in frames)
    points, last = frames[0].points.xyz, frames[3]
    in_last = points @ last.T_camera_world[:3, :3].T + last.T_camera_world[:3, 3]
    pixels = last.undistorter.camera.project(in_last)
    seen = last.undistorter.camera.contains(pixels)
    measured = read_millimetres(capture.tree, capture.frames[3]).metres
    column, row = np.floor(pixels[seen] * 256 / 1920).astype(int).T
    ratio = in_last[seen, 2] / measured[row, column]
    assert seen.sum() > 200
    assert abs(np.median(ratio) - 1) < 0.005
    assert np.mean(np.abs(ratio - 1) < 0.02) > 0.8  # 0.90; the others lie where the last frame sees something else


def test_features_of_euroc_fit_the_poses(shared_data, opened, untriangulated):
    tracker = opened(shared_data("captures") / "euroc", "euroc")
    score = measure_geometry(survey(tracker, len(tracker), lambda _: None)).epipolar
    assert score[STATED].matches > 100
    assert min(score, key=lambda convention: score[convention].error) is STATED
    assert score[STATED].share > 0.9


def test_record3d_metadata_of_the_older_kind(shared_data, tmp_path):
    import zipfile

    with zipfile.ZipFile(shared_data("captures") / "record3d" / "metadata_only.r3d") as archive:
        archive.extract("metadata", tmp_path)
    (tmp_path / "rgbd").mkdir()
    for n in range(49):
        cv2.imwrite(str(tmp_path / f"rgbd/{n}.jpg"), np.zeros((960, 720, 3), np.uint8))
    capture = read_capture(tmp_path, "record3d")
    assert len(capture.frames) == 49
    poses = np.array([frame.T_camera_world for frame in capture.frames])
    np.testing.assert_allclose(poses[0], np.eye(4) @ np.diag([1, -1, -1, 1]), atol=1e-6)  # ARKit's axes, turned
    assert np.median(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)) < 0.02  # a hand, at 60 frames a second
    camera = capture.frames[0].camera
    assert abs(camera.cx - 360) < 5 and abs(camera.cy - 480) < 5


def test_kitti_drives_forward_as_the_camera_looks(shared_data, tmp_path):
    data = shared_data("captures") / "kitti"
    calibration = (data / "calib_cam_to_cam.txt").read_text()
    (tmp_path / "calib.txt").write_text(calibration)
    shutil.copy(data / "times_first300.txt", tmp_path / "times.txt")
    shutil.copy(data / "00_first300.txt", tmp_path / "poses.txt")
    (tmp_path / "image_2").mkdir()
    for n in range(300):
        file = tmp_path / f"image_2/{n:06d}.png"
        cv2.imwrite(str(file), np.zeros((375, 1242, 3), np.uint8)) if n == 0 else shutil.copy(
            tmp_path / "image_2/000000.png", file
        )
    frames = read_capture(tmp_path, "kitti").frames
    first, last = (frames[n].T_camera_world for n in (0, 5))
    assert first is not None and last is not None
    moved = (first @ np.linalg.inv(last))[:3, 3]
    assert moved[2] > 3 * np.abs(moved[:2]).max()
    assert frames[0].T_camera_world is not None  # the colour camera is 6 cm to the left of camera 0
    np.testing.assert_allclose(frames[0].T_camera_world[:3, 3], [0.0597, 0, 0], atol=0.005)


def test_cameras_of_tanks_and_temples_look_at_what_they_go_round(shared_data, tmp_path, opened, untriangulated):
    for n in range(151):
        cv2.imwrite(str(tmp_path / f"{n + 1:06d}.png"), np.zeros((36, 64, 3), np.uint8))
    log = shared_data("captures") / "tanksandtemples" / "test.log"
    frames = opened(tmp_path, "tanksandtemples", {"intrinsics": {"fx": 50}}, path=log).frames
    assert len(frames) == 151  # all are registered
    centres = np.array([-f.T_camera_world[:3, :3].T @ f.T_camera_world[:3, 3] for f in frames])
    inwards = np.array([f.T_camera_world[2, :3] for f in frames])
    towards = centres.mean(axis=0) - centres
    assert np.mean(np.sum(inwards * towards, axis=1) > 0) > 0.9  # the cameras go round an object, and look at it

"""Readers on real recordings: poses against sensor depth, a live SLAM system's output against another's, Aria's files.

Skipped where the data is not there.
"""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from modp_ti.inputs.readers.aria import AriaSettings
from modp_ti.inputs.readers.sevenscenes import SevenScenesSettings
from modp_ti.inputs.readers.stella_vslam import StellaVslamSettings
from modp_ti.inputs.readers.tum import TumSettings
from modp_ti.inputs.replay import PosedImage, ReplayedTracker
from modp_ti.inputs.source_settings import IntrinsicsSettings, SourceSettings
from tests.opening import opened_with


def depth_image(file: Path, per_metre: float) -> NDArray[np.float64]:
    depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(np.float64) / per_metre
    depth[(depth <= 0) | (depth > 5)] = np.nan
    return depth


def cloud_file(file: Path, depth: NDArray[np.float64], K: tuple[float, ...], T_world_camera: NDArray) -> Path:
    """Every 97th pixel of a depth image as a point of the world."""
    v, u = np.divmod(np.arange(0, depth.size, 97), depth.shape[1])
    z = depth[v, u]
    p = np.stack([(u + 0.5 - K[2]) / K[0] * z, (v + 0.5 - K[3]) / K[1] * z, z], axis=1)[np.isfinite(z)]
    np.savetxt(file, p @ T_world_camera[:3, :3].T + T_world_camera[:3, 3])
    return file


def depth_ratio(frame: PosedImage, depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depth of the frame's points over what the sensor saw at their pixels."""
    u, v = np.floor(frame.points.pixels).astype(int).T
    ratio = frame.points.depths(frame.T_camera_world) / depth[v, u]
    return ratio[np.isfinite(ratio)]


def test_tum_poses_carry_one_frame_s_depth_into_the_last(shared_data, tmp_path):
    """Wrong axes, an inverse pose or a wrong time would put the points elsewhere."""
    data = shared_data("tum_fr1_desk")
    listed = [line.split() for line in (data / "groundtruth.txt").read_text().splitlines() if line[0] != "#"]
    table = np.array(listed, dtype=float)
    names = sorted((data / "rgb").iterdir())
    depths = sorted((data / "depth").iterdir())
    row = table[np.abs(table[:, 0] - float(names[0].stem)).argmin()]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(row[4:]).as_matrix(), row[1:4]
    points = cloud_file(tmp_path / "points.txt", depth_image(depths[0], 5000), (517.3, 516.5, 319.1, 255.8), T)
    settings = TumSettings(points=points, max_points=3000)
    tracker = opened_with(SourceSettings(path=data, scale=1.0), settings)
    assert [frame.name for frame in tracker.frames] == [f"rgb/{name.name}" for name in names]
    assert any("images that" in note and "are not there" in note for note in tracker.notes)
    first, last = (depth_ratio(tracker.frames[i], depth_image(depths[i], 5000)) for i in (0, -1))
    assert len(last) > 1000
    assert np.median(np.abs(first - 1)) < 0.005
    moved = np.linalg.norm(np.diff([np.linalg.inv(tracker.frames[i].T_camera_world)[:3, 3] for i in (0, -1)], axis=0))
    assert moved > 0.05
    assert np.median(np.abs(last - 1)) < 0.01


def test_sevenscenes_poses_carry_one_frame_s_depth_into_a_later(shared_data, tmp_path):
    data = shared_data("redkitchen")
    K = (585.0, 585.0, 320.0, 240.0)
    T = np.loadtxt(data / "poses" / "frame-000100.pose.txt")
    depths = [depth_image(data / "depth" / f"frame-{i:06d}.depth.png", 1000) for i in (100, 140)]
    points = cloud_file(tmp_path / "points.txt", depths[0], K, T)
    camera = IntrinsicsSettings(fx=585.0)  # of the depth camera: it is what the poses are of
    source = SourceSettings(path=data, start=100, stop=141, step=40, scale=1.0, intrinsics=camera)
    tracker = opened_with(source, SevenScenesSettings(points=points, max_points=3000))
    assert any("those of the depth camera" in note for note in tracker.notes)
    ratio = depth_ratio(tracker.frames[1], depths[1])
    assert len(ratio) > 500
    assert np.median(np.abs(ratio - 1)) < 0.02


@pytest.fixture(scope="module")
def stella() -> ReplayedTracker:
    data = Path(__file__).resolve().parents[5] / "shared" / "data" / "redkitchen"
    if not data.is_dir():
        pytest.skip("no ../shared/data/redkitchen")
    source = SourceSettings(path=data, scale=0.5)
    return opened_with(source, StellaVslamSettings(path=data / "stella"))


def test_stella_s_trajectory_is_as_near_to_the_other_one_as_is_known_of_it(shared_data, stella):
    """ATE 4.8 cm after similarity alignment (Umeyama), as measured when the data was made."""
    poses = shared_data("redkitchen") / "poses"
    assert len(stella) == 974
    assert any("26 of 1000 images have no pose in frame_trajectory.txt" in note for note in stella.notes)
    ours = np.array([np.linalg.inv(frame.T_camera_world)[:3, 3] for frame in stella.frames])
    names = [frame.name.split(".")[0] for frame in stella.frames]
    theirs = np.array([np.loadtxt(poses / f"{name}.pose.txt")[:3, 3] for name in names])
    a, b = ours - ours.mean(axis=0), theirs - theirs.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    sign = np.array([1, 1, np.sign(np.linalg.det(U @ Vt))])
    scale = (S * sign).sum() / (a**2).sum()
    error = b - scale * a @ (U * sign @ Vt).T
    assert np.sqrt((error**2).sum(axis=1).mean()) == pytest.approx(0.048, abs=0.0005)


def test_aria_s_files_are_read_and_the_missing_one_is_named(shared_data, tmp_path):
    folder = shared_data("aria") / "mps_sample" / "trajectory"
    rows = (folder / "closed_loop_trajectory.csv").read_text().splitlines()
    row = rows[4000].split(",")
    for i in range(2):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((80, 80, 3), 90, np.uint8))
    source = SourceSettings(path=tmp_path, intrinsics=IntrinsicsSettings(fx=40.0))
    settings = AriaSettings(path=folder, time_offset=-float(row[1]) * 1e-6)
    tracker = opened_with(source, settings)

    lines = map(json.loads, (folder / "online_calibration.jsonl").read_text().splitlines())
    nearest = min(lines, key=lambda line: abs(line["tracking_timestamp_us"] - int(row[1])))
    mount = next(c for c in nearest["CameraCalibrations"] if c["Label"] == "camera-rgb")["T_Device_Camera"]
    T_world_device, T_device_camera = np.eye(4), np.eye(4)
    T_world_device[:3, :3] = Rotation.from_quat(np.array(row[6:10], dtype=float)).as_matrix()
    T_world_device[:3, 3] = np.array(row[3:6], dtype=float)
    w, (x, y, z) = mount["UnitQuaternion"]
    T_device_camera[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    T_device_camera[:3, 3] = mount["Translation"]
    expected = np.linalg.inv(T_world_device @ T_device_camera)
    np.testing.assert_allclose(tracker.frames[0].T_camera_world, expected, atol=1e-6)

    with gzip.open(folder / "global_points.csv.gz", "rt") as file:
        next(file)
        certain = sum(float(r.split(",")[5]) <= 0.005 and float(r.split(",")[6]) <= 0.05 for r in file)
    assert f"{certain} of 99472 points of global_points.csv.gz are certain enough" in tracker.notes
    assert any("semidense_observations.csv.gz is missing: it would have said" in note for note in tracker.notes)
    assert all(len(frame.points) >= 200 for frame in tracker.frames)

    drifting = opened_with(source, settings.model_copy(update={"path": folder / "open_loop_trajectory.csv"}))
    assert any("odometry, which drifts" in note for note in drifting.notes)

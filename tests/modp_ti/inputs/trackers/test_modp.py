"""Tracker `modp`: the release's JSON of poses and the points of every frame."""

from __future__ import annotations

import json

import numpy as np
import pytest


@pytest.fixture
def released(recording):
    """Frame i has every point but the i-th."""
    write(recording)
    for i in range(7):
        rows = np.delete(recording.xyz, i, axis=0).tolist()
        recording.write(f"point_cloud/point_cloud_{i}.txt", [" ".join(map(repr, row)) for row in rows])
    return recording


def write(recording, change=lambda cameras: None, name: str = "trajectory.json") -> None:
    cameras = [
        {"T_camera_world": T.tolist(), "image": image}
        for T, image in zip(recording.T_camera_world, recording.names, strict=True)
    ]
    change(cameras)
    (recording.root / name).write_text(json.dumps({"cameras": cameras}))


def test_poses_are_world_to_camera_and_a_point_has_one_number_in_all_frames(released):
    tracker = released.open("modp")
    released.assert_frames(tracker, range(7))
    assert tracker.notes == []
    number = {}
    for i, frame in enumerate(tracker.frames):
        for one, xyz in zip(frame.points.ids.tolist(), map(tuple, frame.points.xyz), strict=True):
            assert number.setdefault(xyz, one) == one
        assert tuple(released.xyz[i]) not in set(map(tuple, frame.points.xyz))
    assert len(set(number.values())) == len(number)


def test_arrays_and_the_files_of_orb_slam3_are_read_too(released):
    clouds = released.root / "point_cloud"
    for i in range(7):
        np.save(clouds / f"point_cloud_{i}.npy", np.delete(released.xyz, i, axis=0))
        (clouds / f"point_cloud_{i}.txt").unlink()
    released.assert_frames(released.open("modp"), range(7))
    clouds.rename(released.root / "orb_point_clouds")
    (released.root / "trajectory.json").rename(released.root / "trajectory_orb.json")
    released.assert_frames(released.open("modp"), range(7))


def test_the_release_s_own_layout_needs_no_more_than_its_folder(released):
    (released.root / "images").rename(released.root / "rectified")
    tracker = released.open("modp", {"path": released.root})
    released.assert_frames(tracker, range(7))
    assert "give source.intrinsics" in released.failure("modp", {"path": released.root, "intrinsics": {}})


def test_what_is_not_there_is_counted(released):
    (released.root / "images" / released.names[1]).unlink()
    (released.root / "point_cloud" / "point_cloud_2.txt").unlink()
    (released.root / "point_cloud" / "point_cloud_3.txt").write_text("")
    write(released, lambda cameras: cameras.pop())
    tracker = released.open("modp")
    assert [frame.name for frame in tracker.frames] == [released.names[i] for i in (0, 2, 3, 4, 5)]
    assert [len(frame.points) > 0 for frame in tracker.frames] == [True, False, False, True, True]
    assert tracker.notes == [
        f"1 cameras of trajectory.json are not in {released.root / 'images'}: skipped",
        "1 of 6 images have no pose in trajectory.json: skipped (the first: view14.png)",
        f"1 frames have no file of points in {released.root / 'point_cloud'}: they bring none",
    ]


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda c: c[2].update(T_camera_world=np.eye(3).tolist()), ["camera 2 (view10.png)", "4 rows of 4 numbers"]),
        (lambda c: c[2].update(T_camera_world=[[1], [2, 3]]), ["camera 2 (view10.png)", "4 rows of 4 numbers"]),
        (lambda c: c[2].update(T_camera_world=(2 * np.eye(4)).tolist()), ["camera 2 (view10.png)", "last row"]),
        (lambda c: c[2].update(T_camera_world=np.diag([1, 2, 1, 1.0]).tolist()), ["camera 2", "no rigid motion"]),
        (lambda c: c[2]["T_camera_world"][1].__setitem__(3, float("nan")), ["camera 2", "NaN"]),
        (lambda c: c[2].pop("image"), ["camera 2 has no `image`"]),
        (
            lambda c: c[2].update(image=c[1]["image"]),
            ["cameras 1 (view9.png) and 2 (view9.png) are both the image view9.png"],
        ),
        (lambda c: [each.update(image="gone.png") for each in c], ["none of its 7 cameras is in", "gone.png"]),
        (lambda c: c.clear(), ["holds no list of `cameras`"]),
    ],
)
def test_wrong_camera_is_named(released, change, parts):
    write(released, change)
    message = released.failure("modp")
    assert "trajectory.json" in message
    for part in parts:
        assert part in message


def test_wrong_point_file_is_named(released):
    cloud = released.write("point_cloud/point_cloud_4.txt", ["1 2 3", "1 2"])
    assert "point_cloud_4.txt:2: holds 2 columns instead of 3" in released.failure("modp")
    released.write("point_cloud/point_cloud_4.txt", ["1 2 3", "1 nan 3"])
    assert "point_cloud_4.txt:2: holds NaN" in released.failure("modp")
    cloud.unlink()
    array = cloud.with_suffix(".npy")
    np.save(array, np.zeros((5, 2)))
    assert "point_cloud_4.npy: holds an array of shape (5, 2)" in released.failure("modp")
    np.save(array, np.array([[0, 0, 1.0], [0, np.inf, 1]]))
    assert "point_cloud_4.npy: point 1 holds NaN or infinite" in released.failure("modp")
    array.write_bytes(array.read_bytes()[:-7])
    assert "point_cloud_4.npy: damaged, cut off" in released.failure("modp")
    np.save(array, np.array([{"a": 1}], dtype=object), allow_pickle=True)  # never unpickled
    assert "point_cloud_4.npy: damaged, cut off, or no array of numbers" in released.failure("modp")
    released.write("point_cloud/point_cloud_4.txt", ["1 2 3"])
    assert "of the same frame; take one of them out" in released.failure("modp")


def test_no_points_at_all_and_broken_json_are_named(released):
    for file in (released.root / "point_cloud").iterdir():
        file.write_text("")
    assert "holds no point for any of the 7 frames" in released.failure("modp")
    for file in (released.root / "point_cloud").iterdir():
        file.unlink()
    assert "holds no point_cloud_<number>.txt" in released.failure("modp")
    (released.root / "point_cloud").rmdir()
    assert "it would have brought the points of each frame" in released.failure("modp")
    (released.root / "point_cloud").mkdir()
    released.write("point_cloud/point_cloud_0.txt", ["1 2 3"])
    (released.root / "trajectory.json").write_text('{"cameras": [\n{"image": ')
    assert "trajectory.json:2: not valid JSON" in released.failure("modp")

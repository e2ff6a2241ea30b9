"""Tracker `tum`: any trajectory in TUM's format, with points of a file or none; what is wrong is named by line."""

from __future__ import annotations

import numpy as np
import pytest

from modp_ti.files.errors import InputError
from modp_ti.inputs.point_cloud import read_point_file
from modp_ti.inputs.protocol import Tracker


@pytest.fixture
def posed(recording):
    recording.write("trajectory.txt", ["# time tx ty tz qx qy qz qw", *recording.tum_lines()])
    recording.write_points()
    return recording


def test_poses_are_turned_to_world_to_camera_and_points_are_projected(posed):
    tracker = posed.open("tum", points=posed.root / "points.txt")
    assert isinstance(tracker, Tracker)
    posed.assert_frames(tracker, range(7))
    assert tracker.notes == []
    frames = list(tracker)
    np.testing.assert_allclose([frame.timestamp for frame in frames], np.arange(7) / 30)
    # One point has one number in every frame: where frames share points, their places are the same.
    for number, xyz in zip(frames[0].points.ids, frames[0].points.xyz, strict=True):
        assert np.array_equal(posed.xyz[number], xyz)


def test_image_and_pose_are_joined_by_the_nearest_time_within_the_limit(posed):
    lines = posed.tum_lines(first_time=100.009)
    shifted = {"time_offset": -100.0, "points": posed.root / "points.txt"}
    posed.write("trajectory.txt", [lines[i] for i in (0, 1, 3, 4, 6)])
    tracker = posed.open("tum", **shifted)
    posed.assert_frames(tracker, [0, 1, 3, 4, 6])
    assert tracker.notes == ["2 of 7 images have no pose in trajectory.txt: skipped (the first: view10.png)"]
    message = posed.failure("tum", max_difference=0.005, **shifted)
    assert "trajectory.txt: no pose lies within 0.005 s of a frame" in message
    assert "0.009000" in message and "source.fps, tracker.time_offset" in message


def test_range_and_scale_of_the_source_hold(posed):
    tracker = posed.open(
        "tum", {"start": 1, "stop": 6, "step": 2, "scale": 0.5, "holdout": 3}, points=posed.root / "points.txt"
    )
    assert [frame.name for frame in tracker] == [posed.names[i] for i in (1, 3, 5)]
    assert [frame.held_out for frame in tracker] == [True, False, False]
    camera = tracker.frames[0].undistorter.camera
    assert (camera.width, camera.fx) == (160, 150.0)


def test_without_a_point_file_points_are_triangulated_on_the_surface(posed):
    tracker = posed.open("tum")
    for frame in tracker.frames:
        assert len(frame.points) >= 100
        assert np.median(np.abs(frame.points.xyz[:, 2])) < 0.02  # the plane z = 0, four away


def test_points_of_a_ply_file_are_the_same(posed):
    header = ["ply", "format ascii 1.0", f"element vertex {len(posed.xyz)}"]
    header += [f"property double {axis}" for axis in "xyz"] + ["end_header"]
    ply = posed.write("points.ply", [*header, *(" ".join(map(repr, row)) for row in posed.xyz.tolist())])
    one, other = (posed.open("tum", points=file) for file in (ply, posed.root / "points.txt"))
    for a, b in zip(one.frames, other.frames, strict=True):
        assert np.array_equal(a.points.xyz, b.points.xyz)


def test_frames_of_a_place_keep_the_same_points_where_there_are_too_many(posed):
    tracker = posed.open("tum", points=posed.root / "points.txt", max_points=15)
    kept = [set(frame.points.ids.tolist()) for frame in tracker.frames]
    assert [len(each) for each in kept] == [15] * 7
    everywhere = posed.open("tum", points=posed.root / "points.txt")
    seen_by_all = set.intersection(*(set(frame.points.ids.tolist()) for frame in everywhere.frames))
    assert len(set.union(*kept)) < 30, "drawn anew for each frame it would be most of the 60"
    # Of 15; drawn anew for each of seven frames, 60 / 4^7 would be: none. 5 to 11 in seven draws.
    assert len(set.intersection(*kept) & seen_by_all) >= 2


@pytest.mark.parametrize(
    ("line", "parts"),
    [
        ("0.1 1 2 3 0 0 1", ["trajectory.txt:4", "7 columns instead of 8"]),
        ("0.1 1 2 3 0 0 0 1 9", ["trajectory.txt:4", "9 columns instead of 8"]),
        ("0.1 1 2 three 0 0 0 1", ["trajectory.txt:4", "not a row of numbers"]),
        ("0.1 nan 2 3 0 0 0 1", ["trajectory.txt:4", "NaN"]),
        ("0.1 1 2 inf 0 0 0 1", ["trajectory.txt:4", "infinite"]),
        ("0.1 1 2 3 0 0 0 0", ["trajectory.txt:4", "a quaternion of zeros"]),
        ("0.1 1 2 3 0.5 0.5 0.5 0.7", ["trajectory.txt:4", "length 1.114 instead of 1"]),
        ("0.01 1 2 3 0 0 0 1", ["trajectory.txt:4", "time 0.010000 does not lie after 0.033333"]),
        ("0.033333 1 2 3 0 0 0 1", ["trajectory.txt:4", "doubles"]),
    ],
)
def test_wrong_line_is_named(posed, line, parts):
    lines = posed.tum_lines()
    posed.write("trajectory.txt", ["# comment", *lines[:2], line, *lines[3:]])
    message = posed.failure("tum", points=posed.root / "points.txt")
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("# nothing\n", ["points.txt: holds no row of x y z (tracker.points)"]),
        ("1 2\n", ["points.txt:1: holds 2 columns instead of 3"]),
        ("1 2 3\n1 2\n", ["points.txt:2", "holds 2 columns"]),
        ("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\n", ["points.txt: not a PLY file"]),
        (
            "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\n"
            "end_header\n",
            ["points.txt: holds no point", "triangulated"],
        ),
        ("0 0 -900\n", ["points.txt: none of its 1 points is seen", "camera to world"]),
    ],
)
def test_point_file_that_is_none_is_named(posed, text, parts):
    (posed.root / "points.txt").write_text(text)
    message = posed.failure("tum", points=posed.root / "points.txt")
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    ("times", "fps"),
    [
        ([0, 1, 2, 3, 4, 5, 6], 30),
        ([1, 2, 3, 4, 5, 6, 7], 30),
        ([0, 1, 2, 3, 4, 5, 6], 1),
        ([1000 * i / 30 for i in range(7)], 30),
        ([round(1000 * i / 30) for i in range(7)], 30),
        ([1e9 * i / 30 for i in range(7)], 30),
    ],
    ids=["frames from 0", "frames from 1", "seconds", "ms", "whole ms", "ns"],
)
def test_times_that_are_no_seconds_are_recognised_and_said(posed, times, fps):
    lines = [f"{time} {line.split(' ', 1)[1]}" for time, line in zip(times, posed.tum_lines(), strict=True)]
    posed.write("trajectory.txt", lines)
    tracker = posed.open("tum", {"fps": fps}, points=posed.root / "points.txt")
    posed.assert_frames(tracker, range(7))
    assert len(tracker.notes) == (0 if fps == 1 else 1)


def test_matrices_are_named_as_such(posed):
    posed.write("trajectory.txt", ["1 0 0 0 0 1 0 0 0 0 1 0"])
    assert "tracker.kind: matrices" in posed.failure("tum")


def test_lines_of_a_lost_tracker_are_left_out(posed):
    lines = posed.tum_lines()
    lost = ["0.001 0 0 0 0 0 0 0", *lines, "9 nan 0 0 0 0 0 1", *(f"{10 + i} 0 0 0 0 0 0 1" for i in range(20))]
    posed.write("trajectory.txt", lost)
    tracker = posed.open("tum", points=posed.root / "points.txt")
    posed.assert_frames(tracker, range(7))
    assert any(note.startswith("2 of") for note in tracker.notes)


def _pcd(xyz: np.ndarray, form: str) -> bytes:
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS rgb x y z normal\nSIZE 4 4 4 4 4\nTYPE U F F F F\nCOUNT 1 1 1 1 3\n"
    head += f"WIDTH {len(xyz)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(xyz)}\nDATA {form}\n"
    if form == "ascii":
        return (head + "".join(f"255 {x!r} {y!r} {z!r} 0 0 1\n" for x, y, z in xyz.tolist())).encode()
    table = np.zeros(len(xyz), [("rgb", "<u4"), ("xyz", "<f4", 3), ("normal", "<f4", 3)])
    table["xyz"] = xyz
    return head.encode() + table.tobytes()


@pytest.mark.parametrize("form", ["pcd ascii", "pcd binary", "npy", "text"])
def test_points_of_other_programs_are_read_and_those_with_nan_left_out(posed, form):
    xyz = np.vstack([posed.xyz[:3], [[np.nan] * 3], posed.xyz[3:]])
    file = posed.root / "cloud"
    if form == "npy":
        with file.open("wb") as stream:
            np.save(stream, xyz)
    elif form == "text":
        np.savetxt(file, xyz)
    else:
        file.write_bytes(_pcd(xyz, form.split()[1]))
    np.testing.assert_allclose(read_point_file(file), posed.xyz, atol=1e-6)


def test_a_pcd_that_is_cut_off_or_compressed_is_named(posed):
    whole = _pcd(posed.xyz, "binary")
    for data, said in (
        (whole[:-9], "damaged"),
        (whole.replace(b"DATA binary", b"DATA binary_compressed"), "compressed"),
    ):
        (posed.root / "cloud.pcd").write_bytes(data)
        with pytest.raises(InputError, match=said):
            read_point_file(posed.root / "cloud.pcd")


def test_what_is_missing_is_named_with_the_key_that_gives_it(posed):
    assert "no such file (tracker.points)" in posed.failure("tum", points=posed.root / "gone.ply")
    assert "no such file (tracker.path)" in posed.failure("tum", path=posed.root / "gone.txt")
    assert "give source.intrinsics" in posed.failure("tum", {"intrinsics": {}})
    (posed.root / "trajectory.txt").write_bytes(b"\x80\x81\x00\x01")
    assert "trajectory.txt: cannot be read as text" in posed.failure("tum")
    (posed.root / "trajectory.txt").unlink()
    assert "set tracker.path to a trajectory in TUM's format" in posed.failure("tum")

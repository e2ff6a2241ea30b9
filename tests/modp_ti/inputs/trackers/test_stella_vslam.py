"""Tracker `stella_vslam`: keyframes as they observed, frames between by projection, and files that are none."""

from __future__ import annotations

import msgpack
import numpy as np
import pytest

from tests.opening import off_pixels, opened, refusal
from tests.samples.filmed import write_text
from tests.samples.kinds import write_sample
from tests.samples.trackers import stella_map

KEYFRAMES = (0, 3, 6)


@pytest.fixture
def tracked(filmed, tmp_path):
    """The folder of a map of three keyframes, and the map."""
    write_sample("stella_vslam", tmp_path / "a", filmed)
    world = stella_map(filmed, KEYFRAMES)
    write(tmp_path / "a", world)
    return tmp_path / "a", world


def write(folder, world) -> None:
    (folder / "map.msg").write_bytes(msgpack.packb(world))


def test_keyframes_see_what_they_observed_where_they_observed_it(tracked, filmed):
    folder, world = tracked
    for keyframe in world["keyframes"].values():  # a quarter pixel off, as observations are
        for keypoint in keyframe["undist_keypts"]:
            keypoint["pt"] = [value + 0.25 for value in keypoint["pt"]]
    write(folder, world)
    tracker = opened(folder, "source.scale=0.5")
    for i in KEYFRAMES:
        frame = tracker.frames[i]
        p = frame.points.xyz @ frame.T_camera_world[:3, :3].T + frame.T_camera_world[:3, 3]
        np.testing.assert_allclose(frame.points.pixels, frame.undistorter.camera.project(p) + 0.125, atol=1e-6)
        np.testing.assert_array_equal(frame.points.xyz, filmed.points[frame.points.ids])


def test_frames_between_see_the_landmarks_of_the_keyframes_around_where_they_project_to(tracked):
    folder, world = tracked
    for keyframe in world["keyframes"].values():  # landmark 40 is observed by no keyframe any more
        keyframe["lm_ids"] = [-1 if i == 40 else i for i in keyframe["lm_ids"]]
    write(folder, world)
    tracker = opened(folder)
    for i in (1, 2, 4, 5):
        points = tracker.frames[i].points
        assert off_pixels(tracker.frames[i]).max() < 1e-3 and len(points) >= 20 and 40 not in points.ids
    assert any("4 frames between keyframes" in note for note in tracker.notes)


def test_frames_without_pose_are_skipped_and_a_missing_trajectory_is_named(tracked, filmed):
    folder, _ = tracked
    write_text(folder / "frame_trajectory.txt", filmed.tum_lines()[2:])
    assert [frame.name for frame in opened(folder).frames] == filmed.names[2:]
    (folder / "frame_trajectory.txt").unlink()
    tracker = opened(folder)
    assert [frame.name for frame in tracker.frames] == [filmed.names[i] for i in KEYFRAMES]
    assert any("frame_trajectory.txt is missing" in note for note in tracker.notes)


def test_lens_of_the_map_is_taken_and_the_users_wins(tracked):
    folder, world = tracked
    world["cameras"]["lens"] |= {"k1": 0.1, "k2": -0.2, "p1": 0.01, "p2": 0.02, "k3": 0.3}
    write(folder, world)
    lens = opened(folder).frames[0].undistorter.distortion
    assert lens.numerator == (0.1, -0.2, 0.3) and lens.tangential == (0.01, 0.02)
    world["cameras"]["lens"] |= {"model_type": "Fisheye", "k4": 0.4}
    write(folder, world)
    lens = opened(folder).frames[0].undistorter.distortion
    assert lens.numerator == (0.1, -0.2, 0.3, 0.4) and lens.fisheye
    undistorter = opened(folder, "source.intrinsics.fx=290").frames[0].undistorter
    assert undistorter.raw.fx == 290.0 and undistorter.distortion.is_identity


CHANGES = {
    "NaN": lambda w: w["keyframes"]["3"].update(trans_cw=[0, float("nan"), 0]),
    "quaternion": lambda w: w["keyframes"]["3"].update(rot_cw=[0, 0, 0, 2.0]),
    "three numbers": lambda w: w["keyframes"]["3"].update(rot_cw=[0, 0, 1.0]),
    "time": lambda w: w["keyframes"]["3"].update(ts="now"),
    "one time": lambda w: w["keyframes"]["3"].update(ts=0.0),
    "lengths": lambda w: w["keyframes"]["3"]["lm_ids"].pop(),
    "place": lambda w: w["keyframes"]["3"]["undist_keypts"][1].pop("pt"),
    "keypoints": lambda w: w["keyframes"]["3"].pop("undist_keypts"),
    "landmark": lambda w: w["landmarks"].pop(str(w["keyframes"]["3"]["lm_ids"][5])),
    "position": lambda w: w["landmarks"]["17"].update(pos_w=[1, 2]),
    "no keyframe": lambda w: w.update(keyframes={}),
    "no landmark": lambda w: w.pop("landmarks"),
    "a list": lambda w: w.update(keyframes=[1, 2]),
    "model": lambda w: w["cameras"]["lens"].update(model_type="Equirectangular"),
    "focal": lambda w: w["cameras"]["lens"].update(fx=-3.0),
    "camera": lambda w: w["keyframes"]["3"].update(cam="other"),
    "size": lambda w: w["cameras"]["lens"].update(cols=640, rows=480),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_is_wrong_in_the_map_is_one_line(tracked, change):
    folder, world = tracked
    CHANGES[change](world)
    write(folder, world)
    assert "map.msg" in refusal(folder)


@pytest.mark.parametrize(
    "data",
    [
        b"\xc1" * 40,  # a byte that MessagePack never uses
        b"\x93\x01\x02\x03",  # a list
        # Arrays within arrays that claim two billion entries each: refused before memory is set aside for them.
        b"\x81\xa9keyframes\x81\xa10\x82\xa2ts" + b"\xdd\x7f\xff\xff\xff" * 200,
        b"\x81\xa9keyframes\x81\xa10\x82\xa2ts\xdb\x7f\xff\xff\xff" + b"x" * 100,
        b"\x81\xa9keyframes\x81\xa10\x82\xa2ts" + b"\x91" * 5000,
        b"SQLite format 3\0" + bytes(100),
    ],
)
def test_other_content_is_refused_in_one_line(tracked, data):
    (tracked[0] / "map.msg").write_bytes(data)
    assert "map.msg" in refusal(tracked[0])


@pytest.mark.parametrize("share", [0.05, 0.5, 0.999])
def test_a_map_that_is_cut_off_is_named_as_such(tracked, share):
    file = tracked[0] / "map.msg"
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    assert "cut off" in refusal(tracked[0])

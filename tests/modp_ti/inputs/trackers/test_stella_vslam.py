"""Tracker `stella_vslam`: keyframes as they observed, frames between by projection, and files that are none."""

from __future__ import annotations

import copy

import msgpack
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

KEYFRAMES = (0, 3, 6)


def map_of(recording) -> dict:
    """The map that stella_vslam would hold of the recording: views 0, 3 and 6, each seeing what projects into it."""
    K = recording.K
    keyframes = {}
    for number, i in zip((0, 2, 11), KEYFRAMES, strict=True):
        T = recording.T_camera_world[i]
        p = recording.xyz @ T[:3, :3].T + T[:3, 3]
        uv = (p / p[:, 2:] @ K.T)[:, :2]
        seen = np.flatnonzero(((uv > 2) & (uv < (318, 238))).all(axis=1))
        ids = [-1, *(100 + seen).tolist(), -1]
        # stella_vslam counts pixel centres from 0; a shift of a quarter pixel stands for what was observed.
        places = [[1.0, 1.0], *(uv[seen] - 0.5 + 0.25).tolist(), [2.0, 2.0]]
        keyframes[str(number)] = {
            "ts": i / 30,
            "cam": "webcam",
            "orb_params": "default",
            "rot_cw": Rotation.from_matrix(T[:3, :3]).as_quat().tolist(),
            "trans_cw": T[:3, 3].tolist(),
            "n_keypts": len(ids),
            "undist_keypts": [{"pt": pt, "ang": 0.0, "oct": 0} for pt in places],
            "lm_ids": ids,
            "descs": [[1, 2, 3, 4, 5, 6, 7, 2**32 - 1]] * len(ids),
            "span_parent": -1,
            "span_children": [],
            "loop_edges": [],
        }
    camera = {"model_type": "Perspective", "setup_type": "Monocular", "cols": 320, "rows": 240, "fps": 30.0}
    camera |= {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2] - 0.5, "cy": K[1, 2] - 0.5}
    camera |= dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0)
    landmarks = {
        str(100 + i): {"1st_keyfrm": 0, "pos_w": xyz, "ref_keyfrm": 0, "n_vis": 9, "n_fnd": 7}
        for i, xyz in enumerate(recording.xyz.tolist())
    }
    return {
        "cameras": {"webcam": camera},
        "orb_params": {"default": {"scale_factor": 1.2}},
        "keyframes": keyframes,
        "landmarks": landmarks,
        "keyframe_next_id": 12,
        "landmark_next_id": 200,
    }


@pytest.fixture
def tracked(recording):
    write(recording, map_of(recording))
    recording.write("frame_trajectory.txt", recording.tum_lines())
    return recording


def write(recording, world) -> None:
    (recording.root / "map.msg").write_bytes(msgpack.packb(world))


def test_keyframes_see_what_they_observed_where_they_observed_it(tracked):
    tracker = tracked.open("stella_vslam", {"intrinsics": {}, "scale": 0.5})
    assert [frame.name for frame in tracker.frames] == tracked.names
    for i in KEYFRAMES:
        frame = tracker.frames[i]
        np.testing.assert_allclose(frame.T_camera_world, tracked.T_camera_world[i], atol=1e-9)
        p = frame.points.xyz @ frame.T_camera_world[:3, :3].T + frame.T_camera_world[:3, 3]
        uv = (p / p[:, 2:] @ tracked.K.T)[:, :2] * 0.5
        np.testing.assert_allclose(frame.points.pixels, uv + 0.125, atol=1e-6)
        for number, xyz in zip(frame.points.ids, frame.points.xyz, strict=True):
            assert np.array_equal(xyz, tracked.xyz[number - 100])
    assert tracker.frames[0].undistorter.raw.cx == pytest.approx(tracked.K[0, 2])


def test_frames_between_see_the_landmarks_of_the_keyframes_around_where_they_project_to(tracked):
    world = map_of(tracked)
    for keyframe in world["keyframes"].values():  # landmark 100 is observed by no keyframe any more
        keyframe["lm_ids"] = [-1 if i == 100 else i for i in keyframe["lm_ids"]]
    write(tracked, world)
    tracker = tracked.open("stella_vslam", {"intrinsics": {}})
    between = [1, 2, 4, 5]
    for i in between:
        frame = tracker.frames[i]
        p = frame.points.xyz @ tracked.T_camera_world[i, :3, :3].T + tracked.T_camera_world[i, :3, 3]
        np.testing.assert_allclose((p / p[:, 2:] @ tracked.K.T)[:, :2], frame.points.pixels, atol=1e-3)
        assert len(frame.points) >= 20 and 100 not in frame.points.ids
    assert [note for note in tracker.notes if "4 frames between keyframes" in note and "project" in note]


def test_frames_without_pose_are_skipped_and_counted_and_a_missing_trajectory_is_named(tracked):
    tracked.write("frame_trajectory.txt", tracked.tum_lines()[2:])
    tracker = tracked.open("stella_vslam", {"intrinsics": {}})
    assert [frame.name for frame in tracker.frames] == tracked.names[2:]
    assert tracker.notes[0] == "2 of 7 images have no pose in frame_trajectory.txt: skipped (the first: view8.png)"
    (tracked.root / "frame_trajectory.txt").unlink()
    tracker = tracked.open("stella_vslam", {"intrinsics": {}})
    assert [frame.name for frame in tracker.frames] == [tracked.names[i] for i in KEYFRAMES]
    assert "frame_trajectory.txt is missing: it would have brought the poses of the frames between" in tracker.notes[1]


def test_lens_of_the_map_is_taken_and_the_user_s_wins(tracked):
    world = map_of(tracked)
    world["cameras"]["webcam"] |= {"k1": 0.1, "k2": -0.2, "p1": 0.01, "p2": 0.02, "k3": 0.3}
    write(tracked, world)
    lens = tracked.open("stella_vslam", {"intrinsics": {}}).frames[0].undistorter.distortion
    assert lens.numerator == (0.1, -0.2, 0.3) and lens.tangential == (0.01, 0.02)
    world["cameras"]["webcam"] |= {"model_type": "Fisheye", "k4": 0.4}
    write(tracked, world)
    lens = tracked.open("stella_vslam", {"intrinsics": {}}).frames[0].undistorter.distortion
    assert lens.numerator == (0.1, -0.2, 0.3, 0.4) and lens.fisheye
    undistorter = tracked.open("stella_vslam", {"intrinsics": {"fx": 290.0}}).frames[0].undistorter
    assert undistorter.raw.fx == 290.0 and undistorter.distortion.is_identity


def changed(change):
    def apply(world):
        world = copy.deepcopy(world)
        change(world)
        return world

    return apply


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda w: w["keyframes"]["2"].update(trans_cw=[0, float("nan"), 0]), ["keyframe 2", "`trans_cw`", "NaN"]),
        (lambda w: w["keyframes"]["2"].update(rot_cw=[0, 0, 0, 2.0]), ["keyframe 2", "length 2 instead of 1"]),
        (lambda w: w["keyframes"]["2"].update(rot_cw=[0, 0, 1.0]), ["keyframe 2", "1 x 4 numbers"]),
        (lambda w: w["keyframes"]["2"].update(ts="now"), ["keyframe 2", "`ts`"]),
        (lambda w: w["keyframes"]["2"].update(ts=0.0), ["keyframes 0 and 2 are of one time"]),
        (lambda w: w["keyframes"]["2"]["lm_ids"].pop(), ["keyframe 2", "lists of one length"]),
        (lambda w: w["keyframes"]["2"]["undist_keypts"][1].pop("pt"), ["keyframe 2", "places of its keypoints"]),
        (lambda w: w["keyframes"]["2"].pop("undist_keypts"), ["keyframe 2 has no `undist_keypts`"]),
        (lambda w: w["keyframes"].update(x={}), ["a keyframe is called 'x'"]),
        (lambda w: w["landmarks"].pop("117"), ["observes landmark 117, which the map lacks"]),
        (lambda w: w["landmarks"]["117"].update(pos_w=[1, 2]), ["landmark 117", "3 numbers"]),
        (lambda w: w["landmarks"]["117"].pop("pos_w"), ["landmark 117 has no `pos_w`"]),
        (lambda w: w.update(keyframes={}), ["holds no keyframe"]),
        (lambda w: w.update(landmarks={}), ["holds no landmark"]),
        (lambda w: w.pop("landmarks"), ["holds no `landmarks`"]),
        (lambda w: w.update(keyframes=[1, 2]), ["map.msg"]),
        (lambda w: w["cameras"]["webcam"].update(model_type="Equirectangular"), ["Equirectangular"]),
        (lambda w: w["cameras"]["webcam"].update(fx="wide"), ["`fx` must be a number"]),
        (lambda w: w["cameras"]["webcam"].update(fx=-3.0), ["focal lengths must be positive"]),
        (lambda w: w["cameras"]["webcam"].update(cols=640, rows=480), ["view8.png is 320x240", "640x480", "0.5 of"]),
        (lambda w: w["keyframes"]["2"].update(cam="other"), ["keyframe 2 is of camera 'other'"]),
    ],
)
def test_what_is_wrong_in_the_map_is_named(tracked, change, parts):
    write(tracked, changed(change)(map_of(tracked)))
    message = tracked.failure("stella_vslam", {"intrinsics": {}})
    assert "map.msg" in message
    for part in parts:
        assert part in message


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.9, 0.999])
def test_map_that_is_cut_off_is_named(tracked, share):
    file = tracked.root / "map.msg"
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    assert "map.msg: the file is cut off" in tracked.failure("stella_vslam")


@pytest.mark.parametrize(
    "data",
    [
        b"\xc1" * 40,  # a byte that MessagePack never uses
        b"\x93\x01\x02\x03",  # a list
        b"not a map at all",
        # Arrays within arrays that claim two billion entries each: refused before memory is set aside for them.
        b"\x81\xa9keyframes\x81\xa10\x82\xa2ts" + b"\xdd\x7f\xff\xff\xff" * 200,
        b"\x81\xa9keyframes\x81\xa10\x82\xa2ts\xdb\x7f\xff\xff\xff" + b"x" * 100,
        b"\x81\xa9keyframes\x81\xa10\x82\xa2ts" + b"\x91" * 5000,
    ],
)
def test_other_content_is_refused_in_one_line(tracked, data):
    (tracked.root / "map.msg").write_bytes(data)
    assert "map.msg" in tracked.failure("stella_vslam")


def test_sqlite_map_and_missing_map_are_named(tracked):
    (tracked.root / "map.msg").write_bytes(b"SQLite format 3\0" + bytes(100))
    assert "an SQLite map" in tracked.failure("stella_vslam")
    assert "no such file (tracker.path)" in tracked.failure("stella_vslam", path=tracked.root / "gone.msg")
    (tracked.root / "map.msg").unlink()
    assert "set tracker.path to a map of stella_vslam" in tracked.failure("stella_vslam")

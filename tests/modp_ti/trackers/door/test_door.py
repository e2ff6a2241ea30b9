"""What comes through the door is what the mapper gets; what is malformed is answered in one line and harms nothing."""

from __future__ import annotations

import os
import signal
import socket
import stat
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from fields.pose_correction import PoseCorrection
from fields.tracked_frame import TrackedFrame
from modp_ti.errors import InputError
from modp_ti.settings import SourceSettings, TrackerSettings
from modp_ti.trackers import Tracker, events
from modp_ti.trackers.colmap import open_colmap
from modp_ti.trackers.door import open_door
from tests.modp_ti.trackers.door.doors import (
    CORRECTION,
    DONE,
    END,
    ERROR,
    FRAME,
    HELLO,
    POSE,
    SIZE,
    WELCOME,
    answer,
    connect,
    correction,
    frame,
    hello,
    late,
    message,
    opened,
    point,
    pose,
)


def greeted(path: Path) -> socket.socket:
    connection = connect(path)
    connection.sendall(message(HELLO, hello()))
    assert answer(connection) == (WELCOME, b"")
    return connection


def colours(frames: list[TrackedFrame]) -> list[int]:
    """The numbers that the frames were sent with."""
    return [int(f.rgba[0, 0, 0]) for f in frames]


def test_frames_come_out_as_they_were_sent(tmp_path: Path) -> None:
    picture = np.arange(SIZE[0] * SIZE[1] * 3, dtype=np.uint8).reshape(SIZE[1], SIZE[0], 3)
    points = point(7, 0.5, 0.25, 2.0, 6.0, 4.0) + point(2**40, 0, 0, -1, 3.0, 3.0) + point(3, 0, 0, 5, 4.0, 3.0)
    with opened(tmp_path / "s", holdout=2) as tracker:
        assert isinstance(tracker, Tracker)
        with greeted(tmp_path / "s") as connection:
            connection.sendall(message(FRAME, frame(5, points=points, image=picture.tobytes())))
            connection.sendall(message(FRAME, frame(9)) + message(END))
            assert answer(connection) == (DONE, struct.pack("<I", 2))
        first, second = list(tracker)
    assert (first.index, first.timestamp, first.held_out) == (0, 0.5, True)
    assert (second.index, second.timestamp, second.held_out) == (1, 0.1 * 9, False)
    np.testing.assert_array_equal(first.rgba[..., :3], picture)
    assert first.mask is None
    np.testing.assert_array_equal(first.T_camera_world, pose(0.5))
    c = first.camera
    assert (c.fx, c.fy, c.cx, c.cy, c.width, c.height) == (9.0, 9.5, 4.0, 3.0, 8, 6)
    # A point behind the camera is none that it sees.
    assert first.points.ids.tolist() == [7, 3]
    np.testing.assert_array_equal(first.points.xyz, [[0.5, 0.25, 2], [0, 0, 5]])
    np.testing.assert_array_equal(first.points.pixels, [[6, 4], [4, 3]])


def test_a_lens_and_a_scale_are_treated_as_the_colmap_reader_does(plane_scene, tmp_path: Path) -> None:
    import pycolmap

    rng = np.random.default_rng(2)
    folder = plane_scene.write_colmap(np.c_[rng.uniform(-1.8, 1.8, (60, 2)), np.zeros(60)])
    model = pycolmap.Reconstruction(str(folder))
    K, k = plane_scene.K, [0.1, -0.05, 0.002, -0.003]
    intrinsics = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    lens = pycolmap.Camera(model="OPENCV", width=320, height=240, params=[*intrinsics, *k])
    model.cameras[1].model, model.cameras[1].params = lens.model, lens.params
    model.write_binary(str(folder))
    source = SourceSettings(path=plane_scene.folder, scale=0.5)
    expected = list(open_colmap(source, TrackerSettings(kind="colmap")))
    with opened(tmp_path / "s", scale=0.5, prefetch=8) as tracker, connect(tmp_path / "s") as connection:
        start = struct.pack("<IIII12d", 320, 240, 2, 1, *intrinsics, *k, *[0.0] * 4)
        connection.sendall(message(HELLO, start + b"a tracker"))
        by_name = {image.name: image for image in model.images.values()}
        for i, (name, T) in enumerate(zip(plane_scene.names, expected, strict=True)):
            seen = sorted(by_name[name].get_observation_points2D(), key=lambda p: p.point3D_id)
            block = b"".join(point(p.point3D_id, *model.points3D[p.point3D_id].xyz, *p.xy) for p in seen)
            data = (plane_scene.folder / name).read_bytes()
            connection.sendall(message(FRAME, frame(i, T=T.T_camera_world, points=block, image=data)))
        connection.sendall(message(END))
        got = list(tracker)
    assert len(got) == len(expected) == 7
    assert "the tracker there is a tracker" in tracker.notes
    for ours, theirs in zip(got, expected, strict=True):
        assert ours.camera == theirs.camera
        np.testing.assert_array_equal(ours.T_camera_world, theirs.T_camera_world)
        np.testing.assert_array_equal(ours.rgba, theirs.rgba)
        for column in ("ids", "xyz", "pixels"):
            np.testing.assert_array_equal(getattr(ours.points, column), getattr(theirs.points, column))
        assert len(ours.points) > 20


def test_poses_may_come_later_and_frames_keep_their_order(tmp_path: Path) -> None:
    with opened(tmp_path / "s", prefetch=8) as tracker, greeted(tmp_path / "s") as connection:
        for number in (1, 2, 4):
            connection.sendall(message(FRAME, frame(number, state=0)))
        connection.sendall(message(FRAME, frame(6)))  # its pose is known before theirs
        connection.sendall(message(FRAME, frame(7, state=2)))  # lost
        connection.sendall(message(POSE, late(4, T=pose(4.0), points=point(1, 0, 0, 3, 4.0, 3.0))))
        connection.sendall(message(POSE, late(2, state=2)))
        connection.sendall(message(POSE, late(1, T=pose(1.0))))
        connection.sendall(message(FRAME, frame(8, state=0)) + message(END))  # nothing comes of the last one
        frames = list(tracker)
        assert answer(connection) == (DONE, struct.pack("<I", 3))
    assert colours(frames) == [1, 4, 6]
    assert [f.index for f in frames] == [0, 1, 2]
    assert [f.timestamp for f in frames] == [0.1, 0.4, 0.1 * 6]
    assert [f.T_camera_world[0, 3] for f in frames] == [1.0, 4.0, 0.1 * 6]
    assert [f.points.ids.tolist() for f in frames] == [[], [1], []]
    assert tracker.notes[-1] == "3 of 6 frames came without a pose: skipped"


def test_a_correction_names_delivered_frames_and_they_are_there_again_with_it(tmp_path: Path) -> None:
    seen = point(5, 0, 0, 3, 4.0, 3.0) + point(6, 0, 0, 4, 4.0, 3.0)
    with opened(tmp_path / "s", prefetch=16) as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(10, points=seen)) + message(FRAME, frame(11, state=2)))
        connection.sendall(message(FRAME, frame(12)) + message(FRAME, frame(14)) + message(FRAME, frame(15)))
        moved = {10: pose(2.0), 14: pose(3.4)}
        connection.sendall(message(CORRECTION, correction(moved, {5: (1.0, 0, 3), 99: (0, 0, 1)})))
        connection.sendall(message(FRAME, frame(16)) + message(END))
        arrived = list(events(tracker))
        again = list(tracker)
    assert [type(e) for e in arrived] == [TrackedFrame] * 4 + [PoseCorrection] + [TrackedFrame]
    revised = arrived[4]
    assert revised.index.tolist() == [0, 2]  # frames by their place among those delivered
    np.testing.assert_array_equal(revised.T_camera_world, [pose(2.0), pose(3.4)])
    assert (revised.ids.tolist(), revised.xyz.tolist()) == ([5, 99], [[1, 0, 3], [0, 0, 1]])
    # 10 moved by 1.0 and 14 by 2.0: the frame between by half of both, the one behind as 14, the new one not at all.
    x = [f.T_camera_world[0, 3] for f in again]
    np.testing.assert_allclose(x, [2.0, 1.2 + 1.5, 3.4, 1.5 + 2.0, 1.6], atol=1e-12)
    assert again[0].points.xyz.tolist() == [[1, 0, 3], [0, 0, 4]]
    assert colours(again) == [10, 12, 14, 15, 16]


def test_alpha_says_which_pixels_count(tmp_path: Path) -> None:
    rgba = np.full((SIZE[1], SIZE[0], 4), 200, dtype=np.uint8)
    rgba[2, 3, 3] = 0
    png = cv2.imencode(".png", rgba)[1].tobytes()
    for encoding, data in ((5, rgba.tobytes()), (2, png)):
        path = tmp_path / f"s{encoding}"
        with opened(path) as tracker, connect(path) as connection:
            connection.sendall(message(HELLO, hello(encoding=encoding)))
            connection.sendall(message(FRAME, frame(1, image=data)) + message(END))
            (only,) = list(tracker)
        assert not only.mask[2, 3]
        assert only.mask.sum() == SIZE[0] * SIZE[1] - 1
        assert only.rgba[0, 0].tolist() == [200, 200, 200, 255]


def test_nothing_more_is_read_while_the_mapper_is_busy(tmp_path: Path) -> None:
    with opened(tmp_path / "s", prefetch=1) as tracker, greeted(tmp_path / "s") as connection:
        sent = 0

        def payload(number: int) -> bytes:
            return struct.pack("<I", number) + frame(number % 250, time=0.1 * number)[4:]

        def push_all() -> None:
            nonlocal sent
            for number in range(1500):
                connection.sendall(message(FRAME, payload(number)))
                sent += 1
            connection.sendall(message(END))

        thread = threading.Thread(target=push_all)
        thread.start()
        before = -1
        while sent != before:  # until it stands still
            before = sent
            time.sleep(0.5)
        assert 0 < sent < 1500
        assert len(os.listdir(tracker._spool.path)) < 10
        assert sum(1 for _ in tracker) == 1500
        thread.join()


# ---- what is malformed ---------------------------------------------------------------------------------------


NAN = np.full((4, 4), np.nan)
MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])
BAD_STARTS = {
    "magic": (
        message(HELLO, hello(), magic=b"GET "),
        "a message must begin with 'MODP', not with the bytes 47 45 54 20",
    ),
    "version": (message(HELLO, hello(), version=2), "version 2 is not spoken here: send version 1"),
    "kind": (message(77), "message kind 77 is not known"),
    "no hello": (message(FRAME, frame(1)), "FRAME before HELLO: the first message must be HELLO"),
    "huge hello": (message(HELLO, length=2**32 - 1), "a HELLO of 4294967295 bytes: its payload has 112 to 176"),
    "short hello": (message(HELLO, b"abc"), "a HELLO of 3 bytes"),
    "huge image": (message(HELLO, hello(16000, 16000)), "images of 16000x16000 are not taken"),
    "no image": (message(HELLO, hello(0, 6)), "images of 0x6 are not taken"),
    "encoding": (message(HELLO, hello(encoding=9)), "image encoding 9 is not known: 1 JPEG, 2 PNG"),
    "lens": (message(HELLO, hello(lens=3)), "lens model 3 is not known"),
    "focal length": (message(HELLO, hello(fx=-1.0)), "focal lengths must be positive, not -1 and 9.5"),
    "NaN": (message(HELLO, hello(fx=float("nan"))), "intrinsics and distortion must be finite numbers"),
}


@pytest.mark.parametrize("case", BAD_STARTS)
def test_a_bad_start_is_answered_and_the_door_stays_open(case: str, tmp_path: Path) -> None:
    sent, said = BAD_STARTS[case]
    with opened(tmp_path / "s") as tracker:
        with connect(tmp_path / "s") as connection:
            connection.sendall(sent)
            kind, text = answer(connection)
            assert kind == ERROR
            assert said in text.decode()
            assert "\n" not in text.decode()
        with greeted(tmp_path / "s") as connection:
            connection.sendall(message(FRAME, frame(1)) + message(END))
            assert colours(list(tracker)) == [1]
        assert any(said in note for note in tracker.notes)


BAD_MESSAGES = {
    "magic": (message(FRAME, frame(3), magic=b"JUNK"), "must begin with 'MODP'"),
    "huge length": (message(FRAME, length=2**31), "a FRAME of 2147483648 bytes: its payload has 152 to 4800296"),
    "huge correction": (message(CORRECTION, length=2**30), "a CORRECTION of 1073741824 bytes"),
    "more points than bytes": (message(FRAME, frame(3, count=9)), "9 points and 144 bytes of image make 728"),
    "points without end": (message(FRAME, frame(3, count=2**32 - 1)), "FRAME 3: 4294967295 points, at most 100000"),
    "hello twice": (message(HELLO, hello()), "HELLO twice"),
    "points without pose": (
        message(FRAME, frame(3, state=0, points=point(1, 0, 0, 1, 1, 1))),
        "FRAME 3: has points and no pose",
    ),
    "no image": (message(FRAME, frame(3, image=b"")), "FRAME 3: has no image"),
    "state": (message(FRAME, frame(3, state=4)), "FRAME 3: state 4 is not known"),
    "pose of a posed frame": (message(POSE, late(2)), "POSE 2: no frame of this number waits for its pose"),
    "pose of no frame": (message(POSE, late(8)), "POSE 8: no frame of this number"),
    "pose with an image": (message(POSE, frame(2)), "POSE 2: must have no image"),
    "pose later again": (message(POSE, late(2, state=0)), "POSE 2: must bring the pose"),
    "correction cut": (
        message(CORRECTION, correction({2: pose()}, {5: (0, 0, 1)})[:-8]),
        "CORRECTION: 1 poses and 1 points make 176 bytes, it has 168",
    ),
}
UNFIT_MESSAGES = {
    "number again": (message(FRAME, frame(2)), "FRAME 2 after FRAME 2: numbers must grow"),
    "number back": (message(FRAME, frame(1)), "FRAME 1 after FRAME 2: numbers must grow"),
    "time back": (message(FRAME, frame(3, time=0.1)), "FRAME 3: its time 0.1 is not after 0.2"),
    "time NaN": (message(FRAME, frame(3, time=float("nan"))), "FRAME 3: the time stamp is not finite"),
    "pose NaN": (message(FRAME, frame(3, T=NAN)), "FRAME 3: the pose holds NaN or infinite numbers"),
    "pose mirrors": (message(FRAME, frame(3, T=MIRROR)), "FRAME 3: the pose mirrors"),
    "pose scales": (message(FRAME, frame(3, T=np.diag([2.0, 2, 2, 1]))), "FRAME 3: the pose is no rigid motion"),
    "point NaN": (message(FRAME, frame(3, points=point(1, 0, float("nan"), 1, 1, 1))), "its points hold NaN"),
    "point twice": (message(FRAME, frame(3, points=point(1, 0, 0, 1, 1, 1) * 2)), "FRAME 3: a point stands twice"),
    "image too short": (message(FRAME, frame(3, image=b"123")), "its image has 3 bytes, HELLO says 144"),
    "correction of no frame": (
        message(CORRECTION, correction({7: pose()}, {})),
        "CORRECTION of frame 7, which has no pose so far",
    ),
    "correction out of order": (
        message(CORRECTION, correction({2: pose(), 1: pose()}, {})),
        "CORRECTION: frames must be named once each, in their order",
    ),
    "correction NaN": (message(CORRECTION, correction({2: NAN}, {})), "CORRECTION of frame 2: the pose holds NaN"),
}


@pytest.mark.parametrize("case", BAD_MESSAGES)
def test_a_malformed_message_ends_the_stream_and_the_run_has_what_came_before(case: str, tmp_path: Path) -> None:
    sent, said = BAD_MESSAGES[case]
    with opened(tmp_path / "s", prefetch=8) as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(1)) + message(FRAME, frame(2)) + sent)
        kind, text = answer(connection)
        assert kind == ERROR
        assert said in text.decode()
        assert "\n" not in text.decode()
        assert colours(list(tracker)) == [1, 2]
        assert said in tracker.notes[-1]
        assert tracker.notes[-1].startswith("the stream ended early: ")
        assert colours(list(tracker)) == [1, 2]  # again
        with pytest.raises(OSError):
            connect(tmp_path / "s")  # nobody else takes over


@pytest.mark.parametrize("case", UNFIT_MESSAGES)
def test_a_message_of_no_use_is_left_out_and_the_stream_goes_on(case: str, tmp_path: Path) -> None:
    sent, said = UNFIT_MESSAGES[case]
    with opened(tmp_path / "s", prefetch=8) as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(1)) + message(FRAME, frame(2)) + sent)
        connection.sendall(message(FRAME, frame(4)) + message(END))
        assert answer(connection) == (DONE, struct.pack("<I", 3))
        assert colours(list(tracker)) == [1, 2, 4]
        assert tracker.notes[-1].startswith("1 message was left out: ")
        assert said in tracker.notes[-1]


def test_a_pose_of_no_use_that_comes_later_loses_its_frame_alone(tmp_path: Path) -> None:
    with opened(tmp_path / "s", prefetch=8) as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(b"".join(message(FRAME, frame(number, state=0)) for number in (1, 2, 3)))
        connection.sendall(message(POSE, late(1)) + message(POSE, late(2, T=NAN)) + message(POSE, late(3)))
        # What is said of a frame that was left out is not heard; of the others it is.
        connection.sendall(message(CORRECTION, correction({2: pose(), 3: pose(7.0)}, {})) + message(POSE, late(2)))
        connection.sendall(message(CORRECTION, correction({2: pose()}, {})) + message(END))
        assert answer(connection) == (DONE, struct.pack("<I", 2))
        events = list(tracker.events())
        assert colours([event for event in events if isinstance(event, TrackedFrame)]) == [1, 3]
        (correction_of_3,) = [event for event in events if isinstance(event, PoseCorrection)]
        assert correction_of_3.index.tolist() == [1]
        assert correction_of_3.T_camera_world[0, 0, 3] == 7.0
        assert tracker.notes[-2].startswith("1 message was left out: POSE 2: the pose holds NaN")
        assert tracker.notes[-1] == "1 of 3 frames came without a pose: skipped"


def test_a_frame_that_was_of_no_use_may_be_sent_again(tmp_path: Path) -> None:
    with opened(tmp_path / "s", prefetch=8) as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(1)) + message(FRAME, frame(2, T=NAN)))
        connection.sendall(message(FRAME, frame(2, state=0)) + message(POSE, late(2)) + message(END))
        assert answer(connection) == (DONE, struct.pack("<I", 2))
        assert colours(list(tracker)) == [1, 2]


def test_too_many_messages_of_no_use_end_the_stream(tmp_path: Path) -> None:
    with opened(tmp_path / "s", prefetch=8) as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(1)))
        connection.sendall(b"".join(message(FRAME, frame(number, T=NAN)) for number in range(2, 10)))
        kind, text = answer(connection)
        assert (kind, text.decode()) == (ERROR, "FRAME 5: the pose holds NaN or infinite numbers")
        assert colours(list(tracker)) == [1]
        assert tracker.notes[-1].startswith("3 messages were left out: the last: FRAME 4: ")
        assert tracker.notes[-2].startswith("the stream ended early: FRAME 5: ")


@pytest.mark.parametrize(
    ("encoding", "make", "said"),
    [
        (1, lambda jpeg, png: jpeg[:-2], "JPEG image is cut off"),
        (1, lambda jpeg, png: png, "its image is no JPEG"),
        (
            2,
            lambda jpeg, png: cv2.imencode(".png", np.zeros((7, 8, 3), np.uint8))[1].tobytes(),
            "is 8x7, HELLO says 8x6",
        ),
        (2, lambda jpeg, png: png[:50] + b"\0" * 20 + png[70:], "PNG image is damaged"),
        (
            2,
            lambda jpeg, png: cv2.imencode(".png", np.zeros((6, 8), np.uint16))[1].tobytes(),
            "not of 8 bits a channel",
        ),
    ],
)
def test_an_image_that_is_not_what_was_said_is_left_out(encoding, make, said, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    picture = rng.integers(0, 255, (6, 8, 3), dtype=np.uint8)
    jpeg, png = (cv2.imencode(suffix, picture)[1].tobytes() for suffix in (".jpg", ".png"))
    with opened(tmp_path / "s") as tracker, connect(tmp_path / "s") as connection:
        connection.sendall(message(HELLO, hello(encoding=encoding)))
        assert answer(connection)[0] == WELCOME
        connection.sendall(message(FRAME, frame(1, image=png if encoding == 2 else jpeg)))
        connection.sendall(message(FRAME, frame(2, image=make(jpeg, png))) + message(END))
        assert answer(connection) == (DONE, struct.pack("<I", 1))
        assert len(list(tracker)) == 1
        assert said in tracker.notes[-1]


DYING = """
import os, signal, sys
sys.path[:0] = sys.argv[2:]
from tests.modp_ti.trackers.door.doors import *
from pathlib import Path
connection = connect(Path(sys.argv[1]))
connection.sendall(message(HELLO, hello()) + message(FRAME, frame(1)) + message(FRAME, frame(2, state=0)))
connection.sendall(message(FRAME, frame(3))[:100])
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_sender_that_dies_in_mid_message_leaves_what_it_had_sent(tmp_path: Path) -> None:
    root = str(Path(__file__).parents[4])
    with opened(tmp_path / "s") as tracker:
        died = subprocess.run([sys.executable, "-c", DYING, str(tmp_path / "s"), root], timeout=60, check=False)
        assert died.returncode == -signal.SIGKILL
        assert colours(list(tracker)) == [1]
        early, without = tracker.notes[-2:]
    assert early == "the stream ended early: the sender ended in mid-message; the run went on with the frames before"
    assert without == "1 of 2 frames came without a pose: skipped"


def test_silence_ends_the_stream(tmp_path: Path) -> None:
    with opened(tmp_path / "s", patience=0.5) as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(1)) + message(FRAME, frame(2))[:20])
        assert colours(list(tracker)) == [1]
        assert answer(connection) == (ERROR, b"the sender was silent for 0.5 s in mid-message")


def test_settings_that_do_not_fit_the_frames_end_the_run_itself(tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    cv2.imwrite(str(masks / "000007.png"), np.zeros((6, 8), np.uint8))
    with opened(tmp_path / "s", masks=masks) as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(1)))
        with pytest.raises(InputError, match="has no mask for 000001"):
            list(tracker)
        assert answer(connection)[0] == ERROR


# ---- where it listens ----------------------------------------------------------------------------------------


def test_a_closed_door_leaves_nothing_behind(tmp_path: Path) -> None:
    with opened(tmp_path / "s") as tracker, greeted(tmp_path / "s") as connection:
        assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o600
        connection.sendall(message(FRAME, frame(1)))
        next(iter(tracker))
        kept = tracker._spool.path
        assert (kept / "000001.rgb8").stat().st_size == 144
    assert not kept.exists()
    assert list(tmp_path.iterdir()) == []
    assert not tracker._thread.is_alive()


def test_an_address_is_of_this_machine_unless_another_is_asked_for() -> None:
    def notes(address: str) -> tuple[str, list[str]]:
        tracker = open_door(SourceSettings(), TrackerSettings(kind="socket", address=address))
        tracker.close()
        return tracker.address, tracker.notes

    assert notes("127.0.0.1:0")[1][1:] == []
    assert "is open to the network" in notes("0.0.0.0:0")[1][1]
    assert TrackerSettings(kind="socket").address is None


def test_an_address_that_cannot_be_is_refused(tmp_path: Path) -> None:
    def failure(**tracker: object) -> str:
        with pytest.raises(InputError) as caught:
            open_door(SourceSettings(), TrackerSettings(kind="socket", **tracker))
        assert "\n" not in str(caught.value)
        return str(caught.value)

    assert "write it as host:port" in failure(address="7007")
    assert "write it as host:port" in failure(address="127.0.0.1:70070")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert "cannot listen there" in failure(address=f"127.0.0.1:{taken.getsockname()[1]}")
    (tmp_path / "file").write_text("precious")
    assert "is there already and no socket" in failure(path=tmp_path / "file")
    assert (tmp_path / "file").read_text() == "precious"
    with opened(tmp_path / "s"):
        assert "another program listens there" in failure(path=tmp_path / "s")
    left = socket.socket(socket.AF_UNIX)
    left.bind(str(tmp_path / "left"))
    left.close()
    with opened(tmp_path / "left") as tracker, greeted(tmp_path / "left") as connection:
        connection.sendall(message(FRAME, frame(1)) + message(END))
        assert len(list(tracker)) == 1

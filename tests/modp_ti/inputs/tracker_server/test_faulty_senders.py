"""What is malformed is answered in one line and harms nothing; what is of no use is left out."""

from __future__ import annotations

import signal
import struct
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.files.errors import InputError
from tests.modp_ti.inputs.tracker_server.clients import (
    CORRECTION,
    DONE,
    END,
    ERROR,
    FRAME,
    HELLO,
    POSE,
    WELCOME,
    answer,
    colours,
    connect,
    correction,
    frame,
    greeted,
    hello,
    late,
    message,
    opened,
    point,
    pose,
)
from tests.patience import PATIENCE

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
def test_a_bad_start_is_answered_and_the_server_stays_open(case: str, tmp_path: Path) -> None:
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
        events = list(tracker)
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
from tests.modp_ti.inputs.tracker_server.clients import *
from pathlib import Path
connection = connect(Path(sys.argv[1]))
connection.sendall(message(HELLO, hello()) + message(FRAME, frame(1)) + message(FRAME, frame(2, state=0)))
connection.sendall(message(FRAME, frame(3))[:100])
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_sender_that_dies_in_mid_message_leaves_what_it_had_sent(tmp_path: Path) -> None:
    root = str(Path(__file__).parents[4])
    with opened(tmp_path / "s") as tracker:
        died = subprocess.run([sys.executable, "-c", DYING, str(tmp_path / "s"), root], timeout=PATIENCE, check=False)
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

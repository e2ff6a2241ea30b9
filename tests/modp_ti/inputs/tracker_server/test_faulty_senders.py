"""What is malformed is answered in one line and harms nothing; what is of no use is left out; nothing is unbounded."""

from __future__ import annotations

import shutil
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from modp_ti.files.errors import InputError
from modp_ti.inputs.tracker_server import TrackerServer, listening, ordering
from modp_ti.inputs.tracker_server.messages import Frame, ProtocolError, State
from modp_ti.inputs.tracker_server.ordering import Ordering
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
    "magic": message(HELLO, hello(), magic=b"GET "),
    "version": message(HELLO, hello(), version=2),
    "kind": message(77),
    "no hello": message(FRAME, frame(1)),
    "huge hello": message(HELLO, length=2**32 - 1),
    "short hello": message(HELLO, b"abc"),
    "huge image": message(HELLO, hello(16000, 16000)),
    "no image": message(HELLO, hello(0, 6)),
    "encoding": message(HELLO, hello(encoding=9)),
    "lens": message(HELLO, hello(lens=3)),
    "focal length": message(HELLO, hello(fx=-1.0)),
    "NaN": message(HELLO, hello(fx=float("nan"))),
    "cut off": message(HELLO, hello())[:40],
}
BAD_MESSAGES = {
    "magic": message(FRAME, frame(3), magic=b"JUNK"),
    "huge length": message(FRAME, length=2**31),
    "huge correction": message(CORRECTION, length=2**30),
    "more points than bytes": message(FRAME, frame(3, count=9)),
    "points without end": message(FRAME, frame(3, count=2**32 - 1)),
    "hello twice": message(HELLO, hello()),
    "points without pose": message(FRAME, frame(3, state=0, points=point(1, 0, 0, 1, 1, 1))),
    "no image": message(FRAME, frame(3, image=b"")),
    "state": message(FRAME, frame(3, state=4)),
    "pose of a posed frame": message(POSE, late(2)),
    "pose of no frame": message(POSE, late(8)),
    "pose with an image": message(POSE, frame(2)),
    "pose later again": message(POSE, late(2, state=0)),
    "correction cut": message(CORRECTION, correction({2: pose()}, {5: (0, 0, 1)})[:-8]),
    "corrections without end": message(CORRECTION, correction({2: pose()}, {})) * 101,
}
UNFIT_MESSAGES = {
    "number again": message(FRAME, frame(2)),
    "number back": message(FRAME, frame(1)),
    "time back": message(FRAME, frame(3, time=0.1)),
    "time NaN": message(FRAME, frame(3, time=float("nan"))),
    "pose NaN": message(FRAME, frame(3, T=NAN)),
    "pose mirrors": message(FRAME, frame(3, T=MIRROR)),
    "pose scales": message(FRAME, frame(3, T=np.diag([2.0, 2, 2, 1]))),
    "point NaN": message(FRAME, frame(3, points=point(1, 0, float("nan"), 1, 1, 1))),
    "point twice": message(FRAME, frame(3, points=point(1, 0, 0, 1, 1, 1) * 2)),
    "image too short": message(FRAME, frame(3, image=b"123")),
    "correction of no frame": message(CORRECTION, correction({7: pose()}, {})),
    "correction out of order": message(CORRECTION, correction({2: pose(), 1: pose()}, {})),
    "correction NaN": message(CORRECTION, correction({2: NAN}, {})),
}


def refused(connection: socket.socket) -> str:
    """The one line with which the server ends a connection."""
    kind, text = answer(connection)
    assert kind == ERROR and text and b"\n" not in text
    return text.decode()


def served(tracker: TrackerServer, path: Path) -> list[int]:
    """The frames that come of a sender that behaves."""
    with connect(path) as connection:
        connection.sendall(message(HELLO, hello()) + message(FRAME, frame(1)) + message(FRAME, frame(2)) + message(END))
        frames = list(tracker)
        assert [answer(connection)[0], answer(connection)[0]] == [WELCOME, DONE]
    return colours(frames)


def test_bad_starts_are_answered_and_counted_in_one_note_and_the_next_sender_is_served(tmp_path: Path) -> None:
    with opened(tmp_path / "s") as tracker:
        for sent in BAD_STARTS.values():
            with connect(tmp_path / "s") as connection:
                connection.sendall(sent)
                connection.shutdown(socket.SHUT_WR)
                said = refused(connection)
        assert served(tracker, tmp_path / "s") == [1, 2]
        (dropped,) = [note for note in tracker.notes if said in note]
    assert dropped.startswith(f"{len(BAD_STARTS)} connections ") and len(tracker.notes) == 2


@pytest.mark.parametrize("case", BAD_MESSAGES)
def test_a_malformed_message_ends_the_stream_and_the_run_has_what_came_before(case: str, tmp_path: Path) -> None:
    with opened(tmp_path / "s") as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(1)) + message(FRAME, frame(2)) + BAD_MESSAGES[case])
        said = refused(connection)
        assert colours(tracker) == [1, 2]
        assert tracker.notes[-1].startswith("the stream ended early: ") and said in tracker.notes[-1]
        with pytest.raises(OSError):
            connect(tmp_path / "s")  # nobody else takes over


@pytest.mark.parametrize("case", UNFIT_MESSAGES)
def test_a_message_of_no_use_is_left_out_and_the_stream_goes_on(case: str, tmp_path: Path) -> None:
    with opened(tmp_path / "s") as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(1)) + message(FRAME, frame(2)) + UNFIT_MESSAGES[case])
        connection.sendall(message(FRAME, frame(4)) + message(END))
        assert answer(connection) == (DONE, struct.pack("<I", 3))
        assert colours(tracker) == [1, 2, 4]
        assert tracker.notes[-1].startswith("1 message was left out: ") and "\n" not in tracker.notes[-1]


def test_a_pose_of_no_use_that_comes_later_loses_its_frame_alone(tmp_path: Path) -> None:
    with opened(tmp_path / "s") as tracker, greeted(tmp_path / "s") as connection:
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


def test_a_frame_that_was_of_no_use_may_be_sent_again(tmp_path: Path) -> None:
    with opened(tmp_path / "s") as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(1)) + message(FRAME, frame(2, T=NAN)))
        connection.sendall(message(FRAME, frame(2, state=0)) + message(POSE, late(2)) + message(END))
        assert answer(connection) == (DONE, struct.pack("<I", 2))
        assert colours(tracker) == [1, 2]


def test_too_many_messages_of_no_use_end_the_stream(tmp_path: Path) -> None:
    with opened(tmp_path / "s") as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(1)))
        connection.sendall(b"".join(message(FRAME, frame(number, T=NAN)) for number in range(2, 10)))
        assert refused(connection).startswith("FRAME 5: ")
        assert colours(tracker) == [1]
        assert tracker.notes[-1].startswith("3 messages were left out")


@pytest.mark.parametrize(
    ("encoding", "make"),
    [
        (1, lambda jpeg, png: jpeg[:-2]),
        (1, lambda jpeg, png: png),
        (2, lambda jpeg, png: cv2.imencode(".png", np.zeros((7, 8, 3), np.uint8))[1].tobytes()),
        (2, lambda jpeg, png: png[:50] + b"\0" * 20 + png[70:]),
        (2, lambda jpeg, png: cv2.imencode(".png", np.zeros((6, 8), np.uint16))[1].tobytes()),
    ],
    ids=["cut off", "another format", "another size", "damaged", "16 bits"],
)
def test_an_image_that_is_not_what_was_said_is_left_out(encoding: int, make, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    picture = rng.integers(0, 255, (6, 8, 3), dtype=np.uint8)
    jpeg, png = (cv2.imencode(suffix, picture)[1].tobytes() for suffix in (".jpg", ".png"))
    greeting, bad = message(HELLO, hello(encoding=encoding)), make(jpeg, png)
    with opened(tmp_path / "s") as tracker:
        with connect(tmp_path / "s") as connection:  # as the first image, it ends the connection
            connection.sendall(greeting + message(FRAME, frame(1, image=bad)))
            assert answer(connection)[0] == WELCOME
            refused(connection)
        with connect(tmp_path / "s") as connection:
            connection.sendall(greeting + message(FRAME, frame(1, image=png if encoding == 2 else jpeg)))
            connection.sendall(message(FRAME, frame(2, image=bad)) + message(END))
            assert answer(connection)[0] == WELCOME
            assert answer(connection) == (DONE, struct.pack("<I", 1))
        assert len(list(tracker)) == 1


def test_a_sender_that_dies_in_mid_message_leaves_what_it_had_sent(tmp_path: Path) -> None:
    with opened(tmp_path / "s") as tracker:
        with greeted(tmp_path / "s") as connection:
            connection.sendall(message(FRAME, frame(1)) + message(FRAME, frame(2, state=0)))
            connection.sendall(message(FRAME, frame(3))[:100])
        assert colours(tracker) == [1]
        assert tracker.notes[-2].startswith("the stream ended early: ")
        assert tracker.notes[-1] == "1 of 2 frames came without a pose: skipped"


def test_settings_that_do_not_fit_the_frames_end_the_run_itself(tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    cv2.imwrite(str(masks / "000007.png"), np.zeros((6, 8), np.uint8))
    with opened(tmp_path / "s", masks=masks) as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(1)))
        with pytest.raises(InputError, match="has no mask for 000001"):
            list(tracker)
        refused(connection)


# ---- patience ----------------------------------------------------------------------------------------------------


def test_silence_ends_the_stream(tmp_path: Path) -> None:
    with opened(tmp_path / "s", patience=0.5) as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(1)) + message(FRAME, frame(2))[:20])
        assert colours(tracker) == [1]
        refused(connection)


@pytest.mark.parametrize("said", [b"", message(HELLO, hello())[:40]])
def test_who_says_nothing_or_hangs_keeps_nobody_out(
    said: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(listening, "FIRST_PATIENCE", 0.1)
    with opened(tmp_path / "s", patience=10 * PATIENCE) as tracker:
        hung = [connect(tmp_path / "s") for _ in range(3)]
        for each in hung:
            each.sendall(said)
        assert served(tracker, tmp_path / "s") == [1, 2]
        for each in hung:
            each.close()


def test_whoever_is_silent_or_trickles_for_too_long_is_sent_away(tmp_path: Path) -> None:
    def trickle() -> Iterator[None]:
        with connect(tmp_path / "s") as connection, suppress(OSError):
            for byte in message(HELLO, hello()):
                connection.sendall(bytes([byte]))
                time.sleep(0.02)
            while connection.recv(100):
                pass
        yield

    with opened(tmp_path / "s", patience=0.3) as tracker, connect(tmp_path / "s") as silent:
        assert silent.recv(1) == b""
        list(trickle())
        assert served(tracker, tmp_path / "s") == [1, 2]
    assert tracker.notes[1].startswith("2 connections to ")


# ---- bounds ------------------------------------------------------------------------------------------------------


def waiting_frame(number: int, state: State, points: int = 0) -> Frame:
    pose = np.eye(4) if state is State.KNOWN else None
    some = SparsePoints(np.zeros((points, 3)), np.zeros((points, 2)), np.arange(points))
    return Frame(number, state, float(number), pose, some, b"")


def test_points_that_wait_are_bounded_and_counted_off_when_they_go() -> None:
    waiting = Ordering()
    most = ordering.MAX_WAITING_BYTES // (48 * 100_000)
    for start in (0, 1_000):  # twice: what has gone does not count
        waiting.add_frame(waiting_frame(start, State.LATER))
        for number in range(start + 1, start + 1 + most):
            waiting.add_frame(waiting_frame(number, State.KNOWN, 100_000))
        waiting.add_pose(waiting_frame(start, State.KNOWN))
        assert len(list(waiting.ready())) == most + 1
    waiting.add_frame(waiting_frame(2_000, State.LATER))
    with pytest.raises(ProtocolError, match="FRAME 2000"):
        for number in range(2_001, 2_002 + most):
            waiting.add_frame(waiting_frame(number, State.KNOWN, 100_000))


@pytest.mark.parametrize(("limit", "most"), [("MAX_WAITING", 6), ("MAX_WAITING_IMAGES", 1000)])  # six of 144 bytes
def test_a_flood_without_poses_ends_the_stream_with_what_came_before(
    limit: str, most: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ordering, limit, most)
    with opened(tmp_path / "s") as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(1)))
        connection.sendall(b"".join(message(FRAME, frame(number, state=0)) for number in range(2, 20)))
        assert colours(tracker) == [1]
        assert refused(connection).startswith("7 frames and corrections") and tracker.live.arrived == 7


def test_nothing_more_is_read_while_too_much_waits_for_the_mapper(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from modp_ti.inputs.tracker_server import tracker as module

    monkeypatch.setattr(module, "MAX_WAITING", 3)
    with opened(tmp_path / "s") as tracker, greeted(tmp_path / "s") as connection:
        sent = 0

        def push_all() -> None:
            nonlocal sent
            for number in range(1500):
                payload = struct.pack("<I", number) + frame(number % 250, time=0.1 * number)[4:]
                connection.sendall(message(FRAME, payload))
                sent += 1
            connection.sendall(message(END))

        thread = threading.Thread(target=push_all)
        thread.start()
        before = -1
        while sent != before:  # until it stands still
            before = sent
            time.sleep(0.5)
        assert 0 < sent < 1500 and tracker.live.arrived <= 3 + 2
        assert sum(1 for _ in tracker) == 1500
        thread.join()


def test_a_full_disk_ends_the_stream_and_the_run_has_what_came_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = iter([1 << 40, 1 << 40, 0])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=next(free, 0)))
    with opened(tmp_path / "s") as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(1)) + message(FRAME, frame(2)))
        assert colours(tracker) == [1]
        assert "less than 1 GiB is free" in refused(connection)
        assert tracker.notes[-1].startswith("the stream ended early: ")

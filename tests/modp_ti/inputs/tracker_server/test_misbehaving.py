"""Peers in other processes that misbehave cost one note, a bounded amount of everything, and never the next tracker."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from modp_ti.inputs.tracker_server import connection, ordering
from tests.modp_ti.inputs.tracker_server.clients import (
    DONE,
    END,
    ERROR,
    FRAME,
    HELLO,
    WELCOME,
    answer,
    colours,
    connect,
    frame,
    hello,
    message,
    opened,
)
from tests.patience import PATIENCE

pytestmark = pytest.mark.slow

SCRIPT = Path(__file__).with_name("misbehaving.py")


def peer(path: Path, how: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-I", "-S", str(SCRIPT), str(path), how],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def served(tracker, path: Path) -> list[int]:
    """The frames that come of a tracker that behaves."""
    with connect(path) as connection:
        connection.sendall(message(HELLO, hello()) + message(FRAME, frame(1)) + message(FRAME, frame(2)) + message(END))
        frames = list(tracker)
        assert answer(connection)[0] == WELCOME
        assert answer(connection)[0] == DONE
    return colours(frames)


def test_bad_starts_are_counted_in_one_note_and_the_next_tracker_is_served(tmp_path: Path) -> None:
    with opened(tmp_path / "s", prefetch=8) as tracker:
        assert peer(tmp_path / "s", "bad starts").wait(timeout=PATIENCE) == 0
        assert served(tracker, tmp_path / "s") == [1, 2]
        dropped = [note for note in tracker.notes if "dropped" in note]
    assert len(dropped) == 1
    assert dropped[0].startswith("21 connections to unix:")
    assert len(tracker.notes) == 2


def test_who_says_nothing_keeps_nobody_out(tmp_path: Path) -> None:
    with opened(tmp_path / "s", prefetch=8) as tracker:
        silent = peer(tmp_path / "s", "silent")
        assert silent.stdout.readline() == "waiting\n"
        assert served(tracker, tmp_path / "s") == [1, 2]
        silent.communicate("", timeout=PATIENCE)


@pytest.mark.parametrize("rest", [b"", message(FRAME, frame(1))[:40], message(FRAME, frame(1))[:-10]])
def test_trackers_that_hang_after_hello_keep_nobody_out(rest: bytes, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(connection, "FIRST_PATIENCE", 0.5)
    with opened(tmp_path / "s", patience=10 * PATIENCE, prefetch=8) as tracker:
        hung = [connect(tmp_path / "s") for _ in range(3)]
        for each in hung:
            each.sendall(message(HELLO, hello()) + rest)
        assert answer(hung[0])[0] == WELCOME
        assert served(tracker, tmp_path / "s") == [1, 2]
        for each in hung:
            each.close()


def test_a_tracker_that_needs_long_for_its_first_frame_is_served_after_others_spoke(tmp_path: Path) -> None:
    with opened(tmp_path / "s", prefetch=8) as tracker, connect(tmp_path / "s") as slow:
        slow.sendall(message(HELLO, hello()))
        assert answer(slow)[0] == WELCOME
        assert peer(tmp_path / "s", "bad starts").wait(timeout=PATIENCE) == 0
        slow.sendall(message(FRAME, frame(1)) + message(FRAME, frame(2)) + message(END))
        assert colours(tracker) == [1, 2]
        assert answer(slow)[0] == DONE


def test_whoever_is_silent_for_too_long_is_sent_away(tmp_path: Path) -> None:
    with opened(tmp_path / "s", patience=0.3) as tracker, connect(tmp_path / "s") as connection:
        assert connection.recv(1) == b""
        assert served(tracker, tmp_path / "s") == [1, 2]
    assert "dropped before the first frame: it said nothing" in tracker.notes[1]


def test_a_message_that_trickles_in_has_a_deadline_as_a_whole(tmp_path: Path) -> None:
    with opened(tmp_path / "s", patience=1.0) as tracker:
        trickling = peer(tmp_path / "s", "trickle")
        assert trickling.wait(timeout=PATIENCE) == 0
        assert served(tracker, tmp_path / "s") == [1, 2]
    assert any("was silent for 1 s in mid-message" in note for note in tracker.notes)


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("frames without poses", "wait for the pose of FRAME 2: send its POSE"),
        ("corrections", "more than 100 CORRECTIONs without a FRAME between them"),
    ],
)
def test_a_flood_ends_the_stream_with_what_came_before(how: str, said: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(ordering, "MAX_WAITING", 50)
    with opened(tmp_path / "s", prefetch=200) as tracker:
        flooding = peer(tmp_path / "s", how)
        frames = list(tracker)
        told, _ = flooding.communicate("", timeout=PATIENCE)
        assert len(os.listdir(tracker._spool.path)) < 60
    assert colours(frames) == [1]
    assert said in told
    assert any(said in note for note in tracker.notes)


def test_images_that_wait_for_their_poses_are_bounded_on_disk(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(ordering, "MAX_WAITING_IMAGES", 1000)  # six of 144 bytes
    with opened(tmp_path / "s", prefetch=8) as tracker, connect(tmp_path / "s") as connection:
        connection.sendall(message(HELLO, hello()) + message(FRAME, frame(1)))
        connection.sendall(b"".join(message(FRAME, frame(number, state=0)) for number in range(2, 20)))
        assert len(list(tracker)) == 1
        assert answer(connection)[0] == WELCOME
        kind, text = answer(connection)
    assert kind == ERROR
    assert text.startswith(b"7 frames and corrections")


def test_a_first_image_that_is_damaged_leaves_the_server_open(tmp_path: Path) -> None:
    with opened(tmp_path / "s") as tracker:
        with connect(tmp_path / "s") as connection:
            connection.sendall(message(HELLO, hello(encoding=2)))
            assert answer(connection)[0] == WELCOME
            png = bytes.fromhex("89504e470d0a1a0a0000000d494844520000000800000006080200000000000000")
            connection.sendall(message(FRAME, frame(1, image=png + bytes(20) + b"\0\0\0\0IEND\xaeB`\x82")))
            assert answer(connection)[0] == ERROR
        assert served(tracker, tmp_path / "s") == [1, 2]


def test_a_full_disk_ends_the_stream_and_the_run_has_what_came_before(tmp_path: Path, monkeypatch) -> None:
    free = iter([1 << 40, 1 << 40, 0])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=next(free, 0)))
    with opened(tmp_path / "s", prefetch=8) as tracker, connect(tmp_path / "s") as connection:
        connection.sendall(message(HELLO, hello()) + message(FRAME, frame(1)) + message(FRAME, frame(2)))
        frames = list(tracker)
        assert answer(connection)[0] == WELCOME
        kind, text = answer(connection)
    assert len(frames) == 1
    assert kind == ERROR
    assert b"less than 1 GiB is free" in text
    assert tracker.notes[-1].startswith("the stream ended early: ")

"""A live source delivers frames as they come, can be read again, keeps what nobody takes, and lets go at its end."""

from __future__ import annotations

import os
import re
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources import live
from modp_ti.inputs.sources.live import LiveSource
from tests.modp_ti.inputs.mjpeg_camera import MjpegCamera, encoded
from tests.patience import PATIENCE

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("interruptible")]


def jpeg(number: int) -> bytes:
    """A flat picture whose grey value tells its number."""
    return encoded(np.full((48, 64, 3), 5 * number, np.uint8))


class Camera(MjpegCamera):
    """send: frames of these numbers."""

    def send(self, *numbers: int) -> None:
        self.send_jpeg(*map(jpeg, numbers))


@pytest.fixture
def camera():
    made = Camera()
    yield made
    made.shut_down()


@pytest.fixture
def opened(camera):
    """Opens the camera, which needs some frames sent to begin with, and closes it at the end of the test.

    By its clock no time passes unless the test says so: a pause of this machine is no slow tracker, nor a slow camera.
    """
    sources = []

    def make(clock=lambda: 100.0) -> LiveSource:
        sources.append(LiveSource(camera.url, clock=clock))
        return sources[-1]

    yield make
    camera.end()  # else their threads wait for the next frame
    for source in sources:
        source.close()


def wait_until(condition) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


def numbers(source: LiveSource, names) -> list[int]:
    return [round(source.read(name).mean() / 5) for name in names]


def test_frames_arrive_in_order_with_their_times_and_can_be_read_again(camera, opened):
    camera.send(*range(6))
    camera.end()
    before = time.time()
    source = opened(time.monotonic)
    names = list(source.arriving(0, None, 1))
    assert names == [f"live_{i:06d}" for i in range(6)] == list(source.names)
    times = [source.timestamp(name) for name in names]
    assert times == sorted(times) and before <= times[0] and times[-1] <= time.time() + 0.5
    for again in range(2):
        assert numbers(source, names) == list(range(6)), again
        assert list(source.arriving(0, None, 1)) == names, "as for the evaluation at a run's end"
    assert list(source.arriving(1, 5, 2)) == ["live_000001", "live_000003"] == list(source.selected(1, 5, 2))
    assert source.position("live_000004") == 4
    assert source.size("live_000004") == (64, 48)
    assert source.find("x/live_000002.png") == "live_000002" and source.find("2") is None
    ended = f"the recording ended: {source.path} sends no more frames"
    assert source.notes[1:] == [ended] and not source.recording
    assert (source.arrivals.arrived, source.arrivals.thinned) == (6, 0)
    arrived = [source.arrived(name) for name in names]
    assert arrived == sorted(arrived) and arrived[-1] == source.arrivals.newest <= time.monotonic()
    assert source.timestamp(names[5]) - source.timestamp(names[0]) == pytest.approx(arrived[5] - arrived[0], abs=1e-5)
    source.add_note("the camera is guessed")
    assert source.notes[1:] == ["the camera is guessed", ended]


def test_a_frame_is_delivered_before_the_next_has_come(camera, opened):
    camera.send(0, 1, 2, 3, 4)  # the decoder looks at some before it opens
    source = opened()
    arriving = source.arriving(0, None, 1)
    first = [next(arriving) for _ in range(3)]
    assert numbers(source, first) == [0, 1, 2]
    camera.send(5, 6, 7, 8, 9)
    assert numbers(source, [next(arriving) for _ in range(4)]) == [3, 4, 5, 6]


def test_frames_that_nobody_takes_wait_on_disk_beyond_a_limit_of_memory(camera, opened, monkeypatch):
    monkeypatch.setattr(live, "MEMORY", 3 * 64 * 48 * 3)
    camera.send(*range(20))
    camera.end()
    source = opened()
    wait_until(lambda: not source._thread.is_alive())
    assert sorted(file.name for file in source.folder.iterdir()) == [f"waiting-{i:06d}.png" for i in range(3, 20)]
    names = list(source.arriving(0, None, 1))
    assert numbers(source, names) == list(range(20))
    assert source._held == 0
    assert sorted(file.name for file in source.folder.iterdir()) == [f"{i:06d}.png" for i in range(20)]


def test_a_slow_tracker_gets_thinned_frames_and_all_are_counted(camera, opened, monkeypatch):
    monkeypatch.setattr(live, "MEMORY", 3 * 64 * 48 * 3)
    camera.send(*range(45))
    camera.end()
    now = [100.0]
    source = opened(lambda: now[0])
    wait_until(lambda: not source._thread.is_alive())
    taken = []
    for name in source.arriving(0, None, 1):
        taken += numbers(source, [name])
        now[0] += 0.02  # the 45 frames came in none
    assert len(taken) + source.arrivals.thinned == source.arrivals.arrived == 45
    assert len(taken) < 45 and taken == sorted(set(taken))
    assert source.notes[-2].startswith(f"{45 - len(taken)} of 45 frames of ")
    assert len(list(source.folder.iterdir())) == len(taken)


def test_a_pause_beyond_the_patience_ends_the_recording_and_is_told(camera, opened, monkeypatch):
    monkeypatch.setattr(live, "PATIENCE", 2.0)
    camera.send(*range(6))
    source = opened()  # and then the camera sends nothing, but keeps the connection
    names = list(source.arriving(0, None, 1))
    assert numbers(source, names) == list(range(len(names))) and len(names) >= 4
    assert re.fullmatch(rf"the recording ended: {source.path} sent nothing for \d+ s", source.notes[-1])


def test_close_ends_the_thread_and_removes_what_was_kept(camera, opened):
    camera.send(*range(6))
    source = opened()
    name = next(source.arriving(0, None, 1))
    folder = Path(source._kept.name)
    assert [file.name for file in folder.iterdir()] == ["000000.png"]
    camera.send(*range(6))
    source.close()
    source.close()  # a second time is no fault
    assert not source._thread.is_alive()
    assert not folder.exists()
    with pytest.raises(InputError, match=r"000000\.png: the frame that was kept there is gone"):
        source.read(name)


def test_ctrl_c_ends_the_recording_and_a_second_one_interrupts(camera, opened):
    camera.send(*range(6))
    source = opened()
    arriving = source.arriving(0, None, 1)
    taken = [next(arriving)]
    os.kill(os.getpid(), signal.SIGINT)
    taken += arriving  # ends though the stream does not
    assert numbers(source, taken) == list(range(len(taken)))
    assert len(source.notes) == 1, "the end was asked for"
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(PATIENCE)


def test_full_disk_is_said_in_one_line(camera, opened, monkeypatch):
    camera.send(*range(6))
    source = opened()

    def full(*_):
        raise OSError(28, "No space left on device")

    said = r"cannot be kept there: No space left on device; make room, or set TMPDIR"
    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_bytes", full)
        with pytest.raises(InputError, match=said):
            next(source.arriving(0, None, 1))
    arriving = source.arriving(0, None, 1)
    taken = [next(arriving)]
    monkeypatch.setattr(Path, "write_bytes", full)
    assert list(arriving) == [] and list(source.names) == taken, "the recording ends with what it has"
    assert source.notes[-1].startswith("the recording ended: ") and "No space left" in source.notes[-1]


@pytest.mark.parametrize("stream", [99, "98", "http://user:secret@127.0.0.1:1/x", __file__])
def test_a_stream_that_is_not_there_is_an_error_without_its_password(stream):
    with pytest.raises(InputError) as caught:
        LiveSource(stream)
    assert "\n" not in str(caught.value) and "secret" not in str(caught.value)

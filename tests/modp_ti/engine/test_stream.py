"""Frames read ahead of the mapper are the same frames, the same errors, and leave no thread behind."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.config.scene_file import load_scene
from modp_ti.engine.session import run_scene
from modp_ti.engine.stream import FramesAhead
from modp_ti.files.errors import InputError, UnreadableImageError
from tests.patience import PATIENCE

CAMERA = PinholeCamera(300.0, 300.0, 120.0, 100.0, 240, 200)


class Source:
    """Frames that are counted when they are read; `bad` is one that cannot be."""

    def __init__(self, frames: int, bad: int | None = None, waits_for: int = 0) -> None:
        self.frames, self.bad, self.waits_for = frames, bad, waits_for
        self.read: list[TrackedFrame] = []
        self.reached = threading.Event()  # `waits_for` frames are read

    def __iter__(self) -> Iterator[TrackedFrame]:
        for index in range(self.frames):
            if index == self.bad:
                raise InputError("image 2 is damaged")
            image = np.full((200, 240, 3), index / 255, dtype=np.float32)
            self.read.append(TrackedFrame(index, 0.0, str(index), image, CAMERA, np.eye(4)))
            if len(self.read) == self.waits_for:
                self.reached.set()
            yield self.read[-1]


@pytest.mark.parametrize("ahead", [0, 1, 3, 100])
def test_the_frames_come_in_their_order_and_end(ahead: int) -> None:
    source = Source(20)
    with FramesAhead(source, ahead) as frames:
        taken = list(frames)
        assert next(frames, None) is None
    assert [frame.index for frame in taken] == list(range(20))
    assert all(a is b for a, b in zip(taken, source.read, strict=True))


def test_frames_and_their_pyramids_are_ready_before_they_are_asked_for_but_no_more_than_wanted() -> None:
    source = Source(50, waits_for=3)
    with FramesAhead(source, 3) as frames:
        assert source.reached.wait(timeout=PATIENCE)
        assert not source.read[3:]
        source.waits_for = 4
        source.reached.clear()
        first = next(frames)
        assert "pyramid" in vars(first)
        assert [level.rgba.shape for level in first.pyramid] == [(200, 240, 4), (100, 120, 4), (50, 60, 4), (25, 30, 4)]
        assert source.reached.wait(timeout=PATIENCE)
        assert len(source.read) == 4


@pytest.mark.parametrize("ahead", [0, 1, 8])
def test_corrections_come_in_their_places(ahead: int) -> None:
    items: list[TrackedFrame | PoseCorrection] = list(Source(6))
    items.insert(3, PoseCorrection(np.arange(3), np.tile(np.eye(4), (3, 1, 1))))
    items.append(PoseCorrection(np.arange(6), np.tile(np.eye(4), (6, 1, 1))))
    with FramesAhead(items, ahead) as ready:
        taken = list(ready)
    assert len(taken) == 8 and all(a is b for a, b in zip(taken, items, strict=True))


@pytest.mark.parametrize("ahead", [0, 1, 8])
def test_an_error_comes_at_its_frame(ahead: int) -> None:
    taken = []
    with pytest.raises(InputError, match="image 2 is damaged"), FramesAhead(Source(9, bad=2), ahead) as frames:
        for frame in frames:
            taken.append(frame.index)
    assert taken == [0, 1]


@pytest.mark.parametrize("frames_taken", [0, 1, 5])
def test_the_thread_ends_with_the_block_whatever_happens_in_it(frames_taken: int) -> None:
    def reading() -> list[threading.Thread]:  # by name: threads of other tests may end meanwhile
        return [thread for thread in threading.enumerate() if thread.name == "frames ahead"]

    assert not reading()
    with pytest.raises(KeyError), FramesAhead(Source(1000), 4) as frames:
        assert len(reading()) == 1
        for _ in range(frames_taken):
            next(frames)
        raise KeyError("the mapper failed")
    assert not reading()


@pytest.mark.slow
def test_a_run_gives_the_same_map_and_the_same_error_with_and_without(plane_scene, tmp_path: Path) -> None:
    x, y = np.meshgrid(np.linspace(-1.2, 1.2, 9), np.linspace(-0.9, 0.9, 7))
    plane_scene.write_colmap(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1))
    scene = plane_scene.folder.parent / "scene.yaml"
    scene.write_text(
        "source: {path: images, holdout: 4, scale: 0.25}\ntracker: {kind: colmap, path: sparse/0}\noutput: out\n"
        "device: cpu\nmapping: {optimise: {steps: 2}, densify: {pixels: 200}}\nrefine: {steps: 2}\n"
        "export: {report: false}\n"
    )
    outputs = [run_scene(load_scene(scene, [f"source.prefetch={n}", f"output={tmp_path / str(n)}"])) for n in (0, 3)]
    for name in ("splats.ply", "trajectory.txt", "scores.csv"):
        first, second = ((output / name).read_bytes() for output in outputs)
        assert first == second, name

    picture = plane_scene.folder / "view11.png"
    data = bytearray(picture.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 2000] = bytes(2000)
    picture.write_bytes(data)
    errors = []
    for prefetch in (0, 3):
        with pytest.raises(UnreadableImageError, match=r"view11\.png") as error:
            run_scene(load_scene(scene, [f"source.prefetch={prefetch}", f"output={tmp_path / 'bad'}"]))
        errors.append(str(error.value))
    assert errors[0] == errors[1]


def test_what_is_there_is_known_before_it_is_taken() -> None:
    more = threading.Event()

    def source() -> Iterator[TrackedFrame]:
        first, second = Source(2)
        yield first
        assert more.wait(timeout=PATIENCE)
        yield second

    with FramesAhead(source(), 2) as frames:
        assert next(frames).index == 0
        assert not frames.ready() and frames.waiting == 0 and frames.peek() is None
        more.set()
        thread = frames._thread
        assert thread is not None
        thread.join(timeout=PATIENCE)  # the second frame and the end are there
        assert frames.ready() and frames.waiting == 2
        peeked = frames.peek()
        assert peeked is not None and peeked.index == 1 and frames.waiting == 2
        assert next(frames) is peeked
        assert frames.ready() and frames.peek() is None, "the end is there, but nothing to take"
        assert next(frames, None) is None and frames.ready()


@pytest.mark.parametrize("ahead", [0, 3])
def test_the_first_frame_stays_the_next_one(ahead: int) -> None:
    with FramesAhead(Source(3), ahead) as frames:
        assert frames.first_frame().index == 0
        assert [frame.index for frame in frames] == [0, 1, 2]
    correction = PoseCorrection(np.arange(1), np.eye(4)[None])
    for events in ([], [correction]):
        with FramesAhead(events, ahead) as frames, pytest.raises(InputError):
            frames.first_frame()
    with FramesAhead(Source(3, bad=0), ahead) as frames, pytest.raises(InputError, match="damaged"):
        frames.first_frame()


def test_an_error_ends_the_wait_for_a_frame_that_is_still_to_come() -> None:
    ended = threading.Event()

    def live() -> Iterator[TrackedFrame]:
        assert ended.wait(timeout=PATIENCE)
        yield from ()

    with pytest.raises(KeyError), FramesAhead(live(), 1, ended.set):
        raise KeyError("Ctrl-C")

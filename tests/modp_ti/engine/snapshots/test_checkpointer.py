"""Snapshots of a run that is under way: what is in them, and what a full disk does to them."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fields.map.trajectory import Trajectory
from fields.runtime.backend import initialise
from modp_ti.config.scene_file import load_scene
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.run_clock import RunClock
from modp_ti.engine.snapshots import FILE, Checkpointer, Snapshot, replay
from modp_ti.engine.snapshots.snapshot import StreamDigest
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import PRIVATE
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.outputs.report.record import RunRecord
from tests.pipelines.test_online import SETTINGS
from tests.pipelines.wall import frame

pytestmark = pytest.mark.slow

FRAMES = 3


class Run:
    """The wall of the mapping tests, mapped with a checkpointer beside it."""

    def __init__(self, folder: Path) -> None:
        (folder / "scene.yaml").write_text(
            "source: {path: images}\ntracker: {kind: colmap}\noutput: out\nsnapshot_every: 2\n"
        )
        self.config = load_scene(folder / "scene.yaml")
        self.mapper = Mapper(64, 48, SETTINGS, seed=5)
        self.record = RunRecord()
        self.said: list[str] = []
        self.checkpointer = Checkpointer(self.config, self.mapper, self.record, RunClock(), self.said.append)
        self.record.begin()

    def take(self, i: int) -> None:
        event = frame(i, held_out=i == 1)
        self.checkpointer.digest.add(event)
        self.record.frame(i, self.mapper.add(event))
        self.checkpointer.after_frame()


@pytest.fixture
def run(tmp_path: Path) -> Run:
    initialise("cpu")
    run = Run(tmp_path)
    for i in range(FRAMES):
        run.take(i)
    return run


def test_it_holds_what_the_run_has_kept(run: Run) -> None:
    assert run.checkpointer.written == 1  # after two frames of three
    assert run.checkpointer.keep() and run.checkpointer.written == 2
    assert run.checkpointer.keep() and run.checkpointer.written == 2  # nothing has happened since
    snapshot = Snapshot.read(run.checkpointer.path)
    assert snapshot.position.events == FRAMES
    trajectory = Trajectory()
    trajectory.restore(snapshot.map.group("tracked"))
    frames: DeliveredFrames = snapshot.frames(trajectory)
    of = run.mapper.frames
    assert (frames.index, frames.name, frames.timestamp) == (of.index, of.name, of.timestamp)
    assert (frames.camera, frames.held_out, frames.corrections) == (of.camera, of.held_out, of.corrections)
    np.testing.assert_array_equal(frames.T_tracked, of.T_tracked)
    for name in ("ids", "xyz", "colours"):
        np.testing.assert_array_equal(getattr(frames.points, name), getattr(of.points, name))
    for mine, theirs in zip(frames.points.pixels, of.points.pixels, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    record = RunRecord()
    snapshot.record(record)
    assert (record.frames, record.steps, record.started) == (run.record.frames, [], run.record.started)


def test_a_full_disk_keeps_the_snapshot_before_and_says_so_once(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    run.checkpointer.keep()
    before = run.checkpointer.path.read_bytes()

    def full(file, **arrays: object) -> None:
        file.write(before[:1000])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, "savez", full)
    failed = run.checkpointer.failed
    for i in (FRAMES, FRAMES + 1):
        run.take(i)
        assert not run.checkpointer.keep()
    assert run.checkpointer.failed > failed
    path = run.checkpointer.path
    (said,) = run.said
    assert all(text in said for text in (str(path.parent), os.strerror(errno.ENOSPC), "the previous one is kept"))
    assert path.read_bytes() == before and sorted(os.listdir(path.parent)) == [PRIVATE, FILE]
    monkeypatch.undo()
    assert run.checkpointer.keep()
    assert Snapshot.read(path).position.events == FRAMES + 2


def test_another_input_is_refused(run: Run) -> None:
    assert run.checkpointer.keep()
    snapshot = Snapshot.read(run.checkpointer.path)
    count = snapshot.position.events
    events = [frame(i, held_out=i == 1) for i in range(count)]
    initialise("cpu")
    with pytest.raises(InputError, match=f"it ended after {count - 1} of {count} frames"):
        replay(snapshot, Mapper(64, 48, SETTINGS), iter(events[:-1]), StreamDigest())
    initialise("cpu")
    image = events[0].image.copy()
    image[3, 4] = 0.0
    others = [replace(events[0], image=image), *events[1:]]
    with pytest.raises(InputError, match="images, poses or points have changed"):
        replay(snapshot, Mapper(64, 48, SETTINGS), iter(others), StreamDigest())

"""A recorded realtime run, repeated: the same bytes, whatever the clock says now."""

from __future__ import annotations

import errno
import json
import os
import shutil
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.config.scene_file import load_scene, scene_from_data
from modp_ti.engine.recording import FILE, RecordedSession, SessionRecorder
from modp_ti.engine.session import run_scene
from modp_ti.files.errors import InputError
from pipelines.companions.pace import Plan
from tests.pipelines.wall import CAMERA, frame

if TYPE_CHECKING:
    from tests.room import RoomRecording

RUN = """
source:  {path: images, holdout: 4, fps: 10}
tracker: {kind: colmap, path: sparse/0}
output:  out
device:  cpu
mapping: {pace: realtime, max_lag: 0.3, densify: {warm_up: 3}}
refine:  {seconds: 0.5}
export:  {session: true, report: false}
"""


@pytest.mark.slow
def test_a_recorded_run_is_repeated_byte_by_byte(room_recording: RoomRecording, tmp_path: Path) -> None:
    room_recording.write(tmp_path)
    scene = tmp_path / "scene.yaml"
    scene.write_text(RUN)
    out = run_scene(load_scene(scene))
    for name in ("images", "sparse"):  # the recording needs nothing else
        (tmp_path / name).rename(tmp_path / f"other-{name}")
    session = RecordedSession(out)
    again = scene_from_data(session.settings | {"output": str(tmp_path / "again")}, "the session")
    run_scene(again, replayed=session)
    for name in ("splats.ply", "trajectory.txt"):
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes(), name
    live = json.loads((tmp_path / "out" / "metrics.json").read_text())["live"]
    assert live["arrived"] == live["tracked"] == 9 and live["seconds_to_map"] > 0.5


def recorded(folder: Path, events: list[TrackedFrame | PoseCorrection]) -> RecordedSession:
    """A session of these events, with a further step before each."""
    recorder = SessionRecorder()
    for event in events:
        recorder.add_further_step()
        if isinstance(event, TrackedFrame):
            recorder.add_frame(event)
        else:
            recorder.add_correction(event, more=False)
    shares = iter([0.0, 0.5, None])
    schedule = recorder.recorded(lambda _: next(shares))
    assert [schedule(step) for step in range(3)] == [0.0, 0.5, None]
    recorder.write(folder / FILE, [Plan(0.5, 3), None], {"settings": {"output": "out"}})
    recorder.close()
    return RecordedSession(folder)


def test_frames_and_corrections_are_read_as_they_were(tmp_path: Path) -> None:
    first, second = frame(0), frame(1, held_out=True)
    mask = np.arange(64) > 3
    first = TrackedFrame(
        **{**vars(first), "mask": np.tile(mask, (48, 1)), "vignette": np.full((48, 64, 3), 0.5, dtype=np.float32)}
    )
    correction = PoseCorrection(np.arange(1), np.eye(4)[None], np.array([7]), np.array([[1.0, 2.0, 3.0]]))
    session = recorded(tmp_path, [first, second, correction])
    a, b, c = session
    for read, written in ((a, first), (b, second)):
        assert isinstance(read, TrackedFrame)
        np.testing.assert_array_equal(read.rgba, written.rgba)
        np.testing.assert_array_equal(read.T_camera_world, written.T_camera_world)
        np.testing.assert_array_equal(read.points.xyz, written.points.xyz)
        np.testing.assert_array_equal(read.points.pixels, written.points.pixels)
        np.testing.assert_array_equal(read.points.ids, written.points.ids)
        assert (read.index, read.name, read.held_out, read.camera) == (
            *(written.index, written.name, written.held_out, CAMERA),
        )
    assert isinstance(a, TrackedFrame) and a.vignette is not None and (a.vignette == 0.5).all()
    assert isinstance(c, PoseCorrection) and c.xyz.tolist() == [[1.0, 2.0, 3.0]] and c.ids.tolist() == [7]
    assert session.plans == [Plan(0.5, 3), None] and session.shares == [0.0, 0.5]
    assert session.further == [1, 1, 1, 0] and session.more == [False] and session.frame_count == 2
    again = list(session.pictures([second.name, "gone"]))
    assert [name for name, _ in again] == [second.name]
    np.testing.assert_array_equal(again[0][1].image, b.image)


def test_a_folder_without_a_session_says_how_to_record_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"there is no recorded session; record one with `export\.session: true`"):
        RecordedSession(tmp_path)


def test_a_full_disk_ends_the_recording_and_not_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    during, at_the_end = SessionRecorder(), SessionRecorder()
    for recorder in (during, at_the_end):
        recorder.add_frame(frame(0))
    with monkeypatch.context() as patched:
        patched.setattr(zipfile.ZipFile, "writestr", full)
        during.add_frame(frame(1))
        during.add_frame(frame(2))
    with monkeypatch.context() as patched:
        patched.setattr(shutil, "copyfile", full)
        at_the_end.write(tmp_path / FILE, [], {})
    during.write(tmp_path / FILE, [], {})
    for recorder in (during, at_the_end):
        assert recorder.problem is not None and recorder.problem.endswith("No space left on device")
        recorder.close()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("damage", ["no zip", "cut off", "no JSON", "other version"])
def test_a_damaged_session_is_one_line(tmp_path: Path, damage: str) -> None:
    recorded(tmp_path, [frame(0)]).close()
    file = tmp_path / FILE
    if damage == "no zip":
        file.write_bytes(b"nothing")
    elif damage == "cut off":
        file.write_bytes(file.read_bytes()[:-100])
    else:
        about = "{" if damage == "no JSON" else json.dumps({"version": 99})
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("about.json", about)
    with pytest.raises(InputError) as error:
        RecordedSession(tmp_path)
    assert str(file) in str(error.value) and "\n" not in str(error.value)

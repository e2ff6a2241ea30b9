"""A run of a given time: the map is there in time, with the steps that the clock allows, and can be repeated."""

from __future__ import annotations

import io
import json
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from rich.console import Console

from modp_ti.config.scene_file import load_scene, scene_from_data
from modp_ti.engine.clocked import TimedRun
from modp_ti.engine.recording import RecordedSession
from modp_ti.engine.results import RunClock
from modp_ti.engine.session import run_scene
from modp_ti.outputs.progress import ProgressLine
from pipelines.refinement import in_steps
from pipelines.settings import RefineSettings

if TYPE_CHECKING:
    from tests.room import RoomRecording

RUN = """
source:  {path: images, holdout: 4, fps: 10}
tracker: {kind: colmap, path: sparse/0}
device:  cpu
mapping: {densify: {warm_up: 3}}
export:  {session: true, report: false}
"""


@pytest.mark.slow
def test_a_timed_run_can_be_repeated_byte_by_byte(
    room_recording: RoomRecording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each reading of the clock takes 0.1 s. If none is left at the first frame, each keyframe gets the least."""
    readings = count()
    monkeypatch.setattr(RunClock, "total", property(lambda _: 0.1 * next(readings)))
    room_recording.write(tmp_path)
    scene = tmp_path / "scene.yaml"
    figures = {}
    for minutes in (0.25, 0.001):
        readings = count()
        scene.write_text(f"{RUN}\noutput: out-{minutes}\nminutes: {minutes}\n")
        out = run_scene(load_scene(scene))
        metrics, session = json.loads((out / "metrics.json").read_text()), RecordedSession(out)
        assert metrics["frames"] == 9
        figures[minutes] = metrics["timed"]["steps_per_keyframe"], len(session.shares or [])
    assert figures[0.001] == (2.0, 0) and figures[0.25] > (4.0, 4)
    session = RecordedSession(tmp_path / "out-0.25")
    again = scene_from_data(session.settings | {"output": str(tmp_path / "again")}, "the session")
    run_scene(again, replayed=session)
    for name in ("splats.ply", "trajectory.txt"):
        assert (again.output / name).read_bytes() == (tmp_path / "out-0.25" / name).read_bytes(), name


def timed_run(tmp_path: Path, used: list[float]) -> TimedRun:
    """A run of a minute, after the last of these times [s]."""
    settings = {"source": {"path": "images"}, "tracker": {"kind": "colmap"}, "output": str(tmp_path), "minutes": 1.0}
    return TimedRun(scene_from_data(settings, "here"), 10, None, lambda: used[-1])


def test_the_refinement_ends_early_enough_to_write_the_map(tmp_path: Path) -> None:
    used = [20.0]
    schedule = timed_run(tmp_path, used).schedule(RefineSettings())
    assert schedule is not None
    shares = []
    while (share := schedule(len(shares))) is not None:
        shares.append(share)
        used.append(used[-1] + 0.25)
    assert shares[0] == 0.0 and shares == sorted(shares) and 0.98 < shares[-1] < 1.0
    assert 55.0 < used[-1] < 60.0


@pytest.mark.parametrize("late", [60.0, 100.0])
def test_after_the_deadline_nothing_is_refined(tmp_path: Path, late: float) -> None:
    schedule = timed_run(tmp_path, [late]).schedule(RefineSettings())
    assert schedule is not None and schedule(0) is in_steps(0)(0) is None


def test_the_progress_shows_the_time_left_until_the_map_is_saved(tmp_path: Path) -> None:
    used = [20.0]
    run, said = timed_run(tmp_path, used), []
    line = ProgressLine(Console(file=io.StringIO()), lambda progress: said.append(progress.left.strip()))
    line.until = run.left
    line.start("mapping", 10)
    line.frame(None)
    used.append(63.0)
    line.frame(None)
    run.saved()
    line.frame(None)
    line.stop()
    assert said[-3:] == ["40 s left", "0 s left", ""]

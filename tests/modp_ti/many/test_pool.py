"""Tasks on this machine: each is a run in a process of its own, and what happens to one happens to no other."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError
from modp_ti.many import pool
from modp_ti.many.pool import Ended, LocalPool, Pool, Resources, open_pool
from modp_ti.many.task import End
from tests.patience import PATIENCE


def scene(finished: Path, folder: Path, **changes: object) -> dict[str, Any]:
    """Settings of a run of the room to `folder`."""
    config = load_scene(finished.parent / "scene.yaml")
    return config.model_dump(mode="json") | {"output": str(folder)} | changes


def until(reached: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not reached():
        assert time.monotonic() < end
        time.sleep(0.005)


def ends(opened: Pool, count: int) -> dict[str, Ended]:
    """The next ends of tasks."""
    found: dict[str, Ended] = {}

    def some() -> bool:
        found.update({event.name: event for event in opened.events(0.1) if isinstance(event, Ended)})
        return len(found) == count

    until(some)
    return found


FAULTY = """
import sys

def look(event, arguments):
    if event == "import" and arguments[0] == "modp_ti.engine.resume":
        raise ZeroDivisionError("of all things")

sys.addaudithook(look)
"""


def test_each_task_ends_in_its_own_way_and_takes_no_other_with_it(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unreadable = scene(finished, tmp_path / "a", source={"path": str(tmp_path / "gone")})
    with LocalPool(tmp_path / "logs", jobs=4) as opened:
        opened.submit("wrong", unreadable, Resources())
        opened.submit("done", scene(finished, finished), Resources())
        opened.submit("killed", unreadable, Resources())
        opened.events(0.0)
        kill = getattr(opened, "_running")["killed"][0]._process.kill  # noqa: B009
        kill()
        (tmp_path / "faulty").mkdir()
        (tmp_path / "faulty" / "sitecustomize.py").write_text(FAULTY)
        monkeypatch.syspath_prepend(tmp_path / "faulty")
        opened.submit("faulty", scene(finished, finished), Resources())
        found = ends(opened, 4)
    assert {name: event.end for name, event in found.items()} == {
        "wrong": End.failed,
        "done": End.done,
        "killed": End.lost,
        "faulty": End.fault,
    }
    assert str(tmp_path / "gone") in found["wrong"].error and "SIGKILL" in found["killed"].error
    assert "ZeroDivisionError: of all things" in (tmp_path / "logs" / "faulty.log").read_text()


class Brief:
    """A task that has ended when it is looked at the second time.

    Attributes:
        running: Tasks that have begun and not ended.
        most: The most of them at a time.
    """

    running = most = 0

    def __init__(self, settings: dict[str, Any], cpus: float, log: Path) -> None:
        Brief.running += 1
        Brief.most = max(Brief.most, Brief.running)
        self._looks = 0

    def news(self) -> str:
        return ""

    def end(self) -> tuple[End, str] | None:
        self._looks += 1
        return None if self._looks == 1 else (End.done, "")

    def close(self) -> None:
        Brief.running -= 1


@pytest.mark.parametrize(
    ("jobs", "resources", "most"),
    [
        (2, Resources(), 2),
        (None, Resources(cpus=10_000.0), 1),  # more than there is: alone
        (3, Resources(gpus=1.0), 1),
        (3, Resources(gpus=0.5), 2),
        (3, Resources(memory=1 << 60), 1),
    ],
)
def test_no_more_tasks_run_at_a_time_than_the_machine_has_room_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jobs: int | None, resources: Resources, most: int
) -> None:
    monkeypatch.setattr(pool, "TaskProcess", Brief)
    Brief.running = Brief.most = 0
    with LocalPool(tmp_path, jobs) as opened:
        for number in range(4):
            opened.submit(str(number), {}, resources)
        assert set(ends(opened, 4)) == set("0123")
    assert (Brief.most, Brief.running) == (most, 0)


@pytest.mark.slow
def test_stopped_tasks_save_what_they_have_and_those_that_wait_do_not_begin(finished: Path, tmp_path: Path) -> None:
    endless = {"snapshot_every": 4, "refine": {"steps": 10_000_000}}
    snapshot = tmp_path / "a" / "snapshot.npz"
    with LocalPool(tmp_path / "logs", jobs=1) as opened:
        for name in ("a", "b"):
            opened.submit(name, scene(finished, tmp_path / name, **endless), Resources())
        until(lambda: not opened.events(0.01) and snapshot.exists())
        opened.stop()
        found = ends(opened, 2)
    assert [event.end for event in found.values()] == [End.interrupted] * 2
    assert "interrupted after" in (tmp_path / "logs" / "a.log").read_text()
    assert snapshot.exists() and not (tmp_path / "b").exists()


@pytest.mark.slow
def test_a_task_saves_what_it_has_when_the_program_that_began_it_is_killed(finished: Path, tmp_path: Path) -> None:
    log = tmp_path / "batch" / "logs" / "a.log"
    settings = ["snapshot_every=4", "refine.steps=10000000", f"output={tmp_path / 'a'}"]
    call = [sys.executable, "-m", "modp_ti.commands.app", "batch", str(finished.parent / "scene.yaml")]
    call += [word for setting in settings for word in ("--set", setting)]
    program = subprocess.Popen([*call, "-o", str(tmp_path / "batch"), "--quiet"])
    until((tmp_path / "a" / "snapshot.npz").exists)
    os.kill(program.pid, signal.SIGKILL)
    program.wait()
    until(lambda: "interrupted" in log.read_text())


def test_options_of_the_other_engine_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--address"):
        open_pool("local", tmp_path, address="10.0.0.1:6379")
    with pytest.raises(InputError, match="--jobs"):
        open_pool("ray", tmp_path, jobs=2)


def test_without_ray_one_line_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"pip install 'modp-ti\[cluster\]'"):
        open_pool("ray", tmp_path)

"""Tasks on this machine: each has a process of its own, and what happens to one happens to no other."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from modp_ti.files.errors import InputError
from modp_ti.tasks import Ended, Resources, Retried, Running, Stopping, Task, Watched, open_engine, run_tasks
from modp_ti.tasks.local import LocalEngine
from modp_ti.tasks.task import End
from tests.modp_ti.tasks import calls
from tests.patience import PATIENCE


def until(reached: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not reached():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_each_task_ends_in_its_own_way_and_takes_no_other_with_it(tmp_path: Path) -> None:
    tasks = [
        Task("dies", partial(calls.die, 9, tmp_path), attempts=2),
        Task("rejects", calls.reject),
        Task("stumbles", calls.stumble),
        Task("doubles", partial(calls.double, 21)),
    ]
    seen: list[Watched | None] = []
    with LocalEngine(jobs=4) as engine:
        answers = run_tasks(engine, tasks, seen.append)
    assert {name: answer.end for name, answer in answers.items()} == {
        "dies": End.lost,
        "rejects": End.failed,
        "stumbles": End.fault,
        "doubles": End.done,
    }
    assert answers["doubles"].value == 42
    assert answers["rejects"].error == "the input is\nof no use"
    assert "SIGKILL" in answers["dies"].error
    assert "in stumble" in answers["stumbles"].traceback
    assert "doubling 21" in [event.report for event in seen if isinstance(event, Running)]
    assert [event.name for event in seen if isinstance(event, Retried)] == ["dies"]
    assert sorted(event.name for event in seen if isinstance(event, Ended)) == sorted(answers)


def test_a_task_whose_process_is_killed_is_begun_again_until_it_ends(tmp_path: Path) -> None:
    with LocalEngine() as engine:
        answers = run_tasks(engine, [Task("dies", partial(calls.die, 2, tmp_path), attempts=3)])
    assert answers["dies"].value == 3


@pytest.mark.parametrize(
    ("jobs", "resources", "most"),
    [
        (2, Resources(), 2),
        (None, Resources(cpus=10_000.0), 1),  # more than there is: alone
        (3, Resources(gpus=1.0), 1),
        (3, Resources(memory=1 << 60), 1),
    ],
)
def test_no_more_tasks_run_at_a_time_than_the_machine_has_room_for(
    tmp_path: Path, jobs: int | None, resources: Resources, most: int
) -> None:
    tasks = [Task(str(i), partial(calls.occupy, tmp_path, str(i)), resources) for i in range(3)]
    with LocalEngine(jobs) as engine:
        answers = run_tasks(engine, tasks)
    assert max(answer.value for answer in answers.values()) <= most


def test_what_a_task_prints_is_in_its_log(tmp_path: Path) -> None:
    with LocalEngine(logs=tmp_path / "logs") as engine:
        run_tasks(engine, [Task("stumbles", calls.stumble)])
    assert "ZeroDivisionError: of all things" in (tmp_path / "logs" / "stumbles.log").read_text()


def test_stopped_tasks_save_what_they_have_and_those_that_wait_do_not_begin(tmp_path: Path) -> None:
    saved = tmp_path / "saved"
    with LocalEngine(jobs=1) as engine:
        engine.submit("runs", partial(calls.wait_for_ctrl_c, saved), Resources())
        engine.submit("waits", partial(calls.wait_for_ctrl_c, tmp_path / "never"), Resources())
        until(lambda: not engine.events(0.01) and saved.with_suffix(".begun").exists())
        engine.stop()
        ends: dict[str, End] = {}

        def both() -> bool:
            ends.update({e.name: e.answer.end for e in engine.events(0.01) if isinstance(e, Ended)})
            return len(ends) == 2

        until(both)
    assert ends == {"runs": End.interrupted, "waits": End.interrupted}
    assert saved.read_text() == "saved" and not (tmp_path / "never.begun").exists()


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_waits_until_the_tasks_have_saved_what_they_have(tmp_path: Path) -> None:
    seen: list[Watched | None] = []
    pressed: list[bool] = []

    def watch(event: Watched | None) -> None:
        seen.append(event)
        if (tmp_path / "a.begun").exists() and not pressed:
            pressed.append(True)
            signal.raise_signal(signal.SIGINT)

    tasks = [Task(name, partial(calls.wait_for_ctrl_c, tmp_path / name)) for name in ("a", "b")]
    with LocalEngine(jobs=1) as engine, pytest.raises(KeyboardInterrupt):
        run_tasks(engine, tasks, watch)
    assert (tmp_path / "a").read_text() == "saved" and not (tmp_path / "b.begun").exists()
    ends = [event.name for event in seen if isinstance(event, Ended)]
    assert Stopping() in seen and sorted(ends) == ["a", "b"]


def test_a_task_saves_what_it_has_when_the_program_that_began_it_is_killed(tmp_path: Path) -> None:
    saved = tmp_path / "saved"
    code = (
        "import sys; from functools import partial; from pathlib import Path\n"
        "from modp_ti.tasks import Task, run_tasks; from modp_ti.tasks.local import LocalEngine\n"
        "from tests.modp_ti.tasks import calls\n"
        "with LocalEngine() as engine:\n"
        "    run_tasks(engine, [Task('a', partial(calls.wait_for_ctrl_c, Path(sys.argv[1])))])"
    )
    program = subprocess.Popen([sys.executable, "-c", code, str(saved)])
    until(saved.with_suffix(".begun").exists)
    os.kill(program.pid, signal.SIGKILL)
    program.wait()
    until(lambda: saved.exists() and saved.read_text() == "saved")


def test_options_of_the_other_engine_are_refused() -> None:
    with pytest.raises(InputError, match="--address is for --engine ray"):
        open_engine("local", address="10.0.0.1:6379")
    with pytest.raises(InputError, match="--jobs is for --engine local"):
        open_engine("ray", jobs=2)


def test_without_ray_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError) as error:
        open_engine("ray")
    assert str(error.value) == "--engine ray needs Ray: pip install 'modp-ti[cluster]'"

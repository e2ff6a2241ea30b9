"""Tasks on a Ray cluster of machines that are processes here; skipped where Ray is not installed."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from modp_ti.files.errors import InputError
from modp_ti.tasks import Retried, Running, Task, Watched, open_engine, run_tasks
from modp_ti.tasks.task import End
from tests.modp_ti.tasks import calls
from tests.modp_ti.tasks.machines import made_cluster, other_machine

pytest.importorskip("ray", reason="Ray is not installed: pip install 'modp-ti[cluster]'")
pytestmark = pytest.mark.slow


@pytest.fixture
def cluster() -> Iterator[Any]:
    import ray

    made = made_cluster()
    yield made
    ray.shutdown()
    made.shutdown()


def test_tasks_end_as_on_this_machine(cluster: Any, tmp_path: Path) -> None:
    tasks = [
        Task("dies", partial(calls.die, 1, tmp_path), attempts=2),
        Task("rejects", calls.reject),
        Task("stumbles", calls.stumble),
        Task("doubles", partial(calls.double, 21)),
    ]
    with open_engine("ray", cluster.address) as engine:
        assert sorted(engine.machines) == [1.0, 1.0]
        answers = run_tasks(engine, tasks)
    assert {name: answer.end for name, answer in answers.items()} == {
        "dies": End.done,
        "rejects": End.failed,
        "stumbles": End.fault,
        "doubles": End.done,
    }
    assert (answers["dies"].value, answers["doubles"].value) == (2, 42)
    assert "in stumble" in answers["stumbles"].traceback


def test_tasks_of_a_machine_that_is_lost_go_on_on_another(cluster: Any) -> None:
    seen: list[Watched | None] = []
    lost: list[bool] = []

    def watch(event: Watched | None) -> None:
        seen.append(event)
        if len({e.name for e in seen if isinstance(e, Running)}) == 2 and not lost:
            lost.append(True)
            other_machine(cluster).lose()

    tasks = [Task(name, partial(calls.rest, 3.0)) for name in ("a", "b")]
    with open_engine("ray", cluster.address) as engine:
        answers = run_tasks(engine, tasks, watch)
    assert [answer.end for answer in answers.values()] == [End.done, End.done]
    assert [event.attempt for event in seen if isinstance(event, Retried)] == [2]


def test_a_cluster_that_cannot_be_reached_is_said_in_one_line() -> None:
    with pytest.raises(InputError, match=r"^Ray at 127\.0\.0\.1:1 cannot be reached: Connection refused; start it"):
        open_engine("ray", "127.0.0.1:1")

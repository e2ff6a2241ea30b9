"""Tasks on a Ray cluster of machines that are processes here; skipped where Ray is not installed."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from modp_ti.files.errors import InputError
from modp_ti.tasks import Retried, Running, Task, Watched, open_engine, run_tasks
from modp_ti.tasks.task import End
from tests.modp_ti.tasks import calls

pytest.importorskip("ray", reason="Ray is not installed: pip install 'modp-ti[cluster]'")
pytestmark = pytest.mark.slow


@pytest.fixture
def cluster() -> Iterator[Any]:
    """A cluster of a head, which runs no tasks, and two machines of one core."""
    import ray
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    for _ in range(2):
        made.add_node(num_cpus=1)
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


def test_tasks_of_a_machine_that_is_lost_go_on_on_another(cluster: Any, tmp_path: Path) -> None:
    raylet = list(cluster.worker_nodes)[-1].all_processes["raylet"][0].process
    seen: list[Watched | None] = []

    def watch(event: Watched | None) -> None:
        seen.append(event)
        if len({e.name for e in seen if isinstance(e, Running)}) == 2 and raylet.poll() is None:
            os.kill(raylet.pid, signal.SIGKILL)

    tasks = [Task(name, partial(calls.rest, 3.0)) for name in ("a", "b")]
    with open_engine("ray", cluster.address) as engine:
        answers = run_tasks(engine, tasks, watch)
    assert [answer.end for answer in answers.values()] == [End.done, End.done]
    assert [event.attempt for event in seen if isinstance(event, Retried)] == [2]


def test_a_cluster_that_cannot_be_reached_is_said_in_one_line() -> None:
    with pytest.raises(InputError, match=r"^Ray at 127\.0\.0\.1:1 cannot be used: .*; start it"):
        open_engine("ray", "127.0.0.1:1")

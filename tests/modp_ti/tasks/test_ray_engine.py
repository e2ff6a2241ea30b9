"""Tasks on a Ray cluster of machines that are processes here; skipped where Ray is not installed."""

from __future__ import annotations

import os
import subprocess
import sys
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


STRANGER = """
import sys, ray
ray.init(sys.argv[1], log_to_driver=False, logging_level="error")
print("came in", ray.get(ray.remote(num_cpus=0)(lambda: 42).remote()))
"""


def test_a_cluster_of_its_own_lets_nobody_in_and_joins_no_other(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("RAY_ADDRESS", "RAY_AUTH_MODE", "RAY_AUTH_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    outside = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    with open_engine("ray", None):
        import ray

        address = ray.get_runtime_context().gcs_address
        assert address != cluster.address  # which Ray's temporary folder names
        call = [sys.executable, "-c", STRANGER, address]
        came = subprocess.run(call, env=outside | {"HOME": str(tmp_path)}, capture_output=True, text=True)
        assert came.returncode != 0 and "came in" not in came.stdout
        ours = subprocess.run(call, env=dict(os.environ), capture_output=True, text=True)
        assert "came in 42" in ours.stdout


def test_a_cluster_that_cannot_be_reached_is_said_in_one_line() -> None:
    with pytest.raises(InputError, match=r"^Ray at 127\.0\.0\.1:1 cannot be reached: Connection refused; start it"):
        open_engine("ray", "127.0.0.1:1")

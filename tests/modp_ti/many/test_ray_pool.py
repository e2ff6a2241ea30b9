"""A batch on a Ray cluster of machines that are processes here; skipped where Ray is not installed."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from modp_ti.files.errors import InputError
from modp_ti.many.batch import read_scenes, run_batch
from modp_ti.many.pool import Ended, Running, open_pool
from modp_ti.many.results import State
from tests.modp_ti.many.machines import made_cluster, other_machine

pytest.importorskip("ray", reason="Ray is not installed: pip install 'modp-ti[cluster]'")
pytestmark = pytest.mark.slow


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    import ray  # an extra

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([os.getcwd(), *sys.path]))  # for the processes of the cluster
    made = made_cluster()
    yield made
    ray.shutdown()
    made.shutdown()


def test_scenes_of_a_lost_machine_are_mapped_on_another_to_the_same_bytes(
    cluster: Any, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from modp_ti.many.ray_pool import RayPool

    class LosingPool(RayPool):
        """Loses a machine of its cluster when two tasks have begun."""

        def events(self, wait: float) -> list[Running | Ended]:
            found, before = super().events(wait), len(begun)
            begun.update(event.name for event in found if isinstance(event, Running))
            if before < 2 <= len(begun):
                other_machine(cluster).lose()
            return found

    begun: set[str] = set()
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "no-torch"))
    text = (finished.parent / "scene.yaml").read_text().replace("path: ", f"path: {finished.parent}/")
    files = []
    for name in ("a", "b", "c"):
        files.append(tmp_path / f"{name}.yaml")
        files[-1].write_text(text.replace("output:  out", f"output: maps/{name}"))
    files[2].write_text(files[2].read_text().replace("/images", "/no-images"))
    with LosingPool(tmp_path / "logs", cluster.address) as pool:
        assert sorted(pool.machines) == [1.0, 1.0]
        results = run_batch(read_scenes(files), pool, tmp_path / "batch")
    assert [result.state for result in results] == [State.finished, State.finished, State.failed]
    assert "no-images" in results[2].error and results[2].machine
    assert sorted(result.attempts for result in results[:2]) == [1, 2]
    for name in ("a", "b"):
        for file in ("splats.ply", "trajectory.txt", "scores.csv"):
            assert (tmp_path / "maps" / name / file).read_bytes() == (finished / file).read_bytes()
        assert "device: CPU" in (tmp_path / "logs" / f"{name}.log").read_text()


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
    with open_pool("ray", tmp_path):
        import ray  # an extra

        address = ray.get_runtime_context().gcs_address
        assert address != cluster.address  # which Ray's temporary folder names
        call = [sys.executable, "-c", STRANGER, address]
        came = subprocess.run(call, env=outside | {"HOME": str(tmp_path)}, capture_output=True, text=True)
        assert came.returncode != 0 and "came in" not in came.stdout
        ours = subprocess.run(call, env=dict(os.environ), capture_output=True, text=True)
        assert "came in 42" in ours.stdout


def test_a_cluster_that_cannot_be_reached_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"127\.0\.0\.1:1 cannot be reached"):
        open_pool("ray", tmp_path, "127.0.0.1:1")

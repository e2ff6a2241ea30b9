"""A batch on a Ray cluster that loses a machine; skipped where Ray is not installed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from modp_ti.batch.batch import run_batch
from modp_ti.batch.results import State
from modp_ti.batch.scenes import read_scenes
from modp_ti.tasks import Ended, Running
from modp_ti.tasks.ray_engine import RayEngine
from tests.modp_ti.tasks.machines import made_cluster, other_machine

pytest.importorskip("ray", reason="Ray is not installed: pip install 'modp-ti[cluster]'")
pytestmark = pytest.mark.slow


class LosingEngine(RayEngine):
    """Loses a machine of its cluster when two calls run."""

    def __init__(self, cluster: Any) -> None:
        super().__init__(cluster.address)
        self._cluster = cluster
        self._begun: set[str] = set()

    def events(self, wait: float) -> list[Running | Ended]:
        found = super().events(wait)
        before = len(self._begun)
        self._begun |= {event.name for event in found if isinstance(event, Running)}
        if before < 2 <= len(self._begun):
            other_machine(self._cluster).lose()
        return found


def test_scenes_of_a_lost_machine_are_mapped_on_another_to_the_same_bytes(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "no-torch"))
    monkeypatch.setenv("PYTHONPATH", os.getcwd())  # for the processes of the cluster
    text = (finished.parent / "scene.yaml").read_text().replace("path: ", f"path: {finished.parent}/")
    files = []
    for name in ("a", "b", "c"):
        files.append(tmp_path / f"{name}.yaml")
        files[-1].write_text(text.replace("output:  out", f"output: maps/{name}"))
    files[2].write_text(files[2].read_text().replace("/images", "/no-images"))
    cluster = made_cluster()
    try:
        with LosingEngine(cluster) as engine:
            results = run_batch(read_scenes(files), engine, tmp_path / "batch")
    finally:
        cluster.shutdown()
    assert [result.state for result in results] == [State.finished, State.finished, State.failed]
    assert sorted(result.attempts for result in results[:2]) == [1, 2]
    for name in ("a", "b"):
        for file in ("splats.ply", "trajectory.txt", "scores.csv"):
            assert (tmp_path / "maps" / name / file).read_bytes() == (finished / file).read_bytes()

"""A batch of real runs: what is finished stays, what is lost goes on, and what fails takes nothing with it."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from modp_ti.commands.app import app
from modp_ti.files.errors import InputError
from modp_ti.many.batch import Shares, read_scenes, run_batch, with_store
from modp_ti.many.pool import Ended, LocalPool, Resources, Running
from modp_ti.many.results import State
from modp_ti.many.task import End

SAME = ("splats.ply", "trajectory.txt", "frames.json", "scores.csv")


# Kills the process that the module is loaded into just before its third snapshot, and removes its output folder: what a
# lost machine leaves is what was copied to a storage, and nothing else.
LOSING = """
import os, shutil, signal, sys

left = 3

def look(event, arguments):
    global left
    if event == "os.rename" and str(arguments[1]) == {output!r} + "/snapshot.npz" and not os.path.exists({died!r}):
        left -= 1
        if left == 0:
            open({died!r}, "w").close()
            shutil.rmtree({output!r})
            os.kill(os.getpid(), signal.SIGKILL)

sys.addaudithook(look)
"""


class FaultyPool(LocalPool):
    """Its tasks fail after they have done all."""

    def events(self, wait: float) -> list[Running | Ended]:
        found = super().events(wait)
        return [
            replace(event, end=End.fault, error="KeyError") if isinstance(event, Ended) else event for event in found
        ]


@pytest.fixture
def recordings(finished: Path, tmp_path: Path) -> Path:
    """A folder with the scenes `done`, whose output folder is finished, `new` and `empty`, which has no images."""
    text = (finished.parent / "scene.yaml").read_text()
    for name in ("done", "new", "empty"):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "scene.yaml").write_text(text.replace("output:  out", f"output:  ../maps/{name}"))
        if name != "empty":
            (folder / "images").symlink_to(finished.parent / "images")
        (folder / "sparse").symlink_to(finished.parent / "sparse")
    shutil.copytree(finished, tmp_path / "maps" / "done")
    written = tmp_path / "maps" / "done" / "config.yaml"
    written.write_text(written.read_text().replace(str(finished.parent), str(tmp_path / "done")))
    return tmp_path


def scene_files(recordings: Path) -> list[Path]:
    return [recordings / name / "scene.yaml" for name in ("done", "new", "empty", "gone")]


def times(folder: Path) -> Mapping[Path, int]:
    return {file: file.stat().st_mtime_ns for file in folder.rglob("*") if file.is_file()}


def test_a_batch_finishes_what_it_can_and_repeats_nothing(
    recordings: Path, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(recordings / "no-torch"))
    maps, folder, store = recordings / "maps", recordings / "batch", recordings / "store"
    kept = times(maps / "done")
    scenes = with_store(read_scenes(scene_files(recordings), ["snapshot_every=2"]), f"file://{store}")
    code = LOSING.format(output=str(maps / "new"), died=str(recordings / "died"))
    (recordings / "sitecustomize.py").write_text(code)
    monkeypatch.syspath_prepend(recordings)
    with LocalPool(folder / "logs", jobs=1) as pool:
        results = run_batch(scenes, pool, folder)

    states = {result.name: result.state for result in results}
    assert states == {"done": State.before, "new": State.finished, "empty": State.failed, "scene.yaml": State.failed}
    assert times(maps / "done") == kept
    new = results[1]
    assert (new.attempts, new.row["resumed"], new.row["frames"]) == (2, 1, 9) and (recordings / "died").exists()
    for name in SAME:
        assert (maps / "new" / name).read_bytes() == (finished / name).read_bytes(), name
    assert "no such folder of images" in results[2].error
    assert results[3].error == f"{recordings / 'gone' / 'scene.yaml'}: no such file"
    (stored,) = store.glob("new-*")
    assert (stored / "output" / "splats.ply").read_bytes() == (finished / "splats.ply").read_bytes()
    assert not (stored / "snapshot.npz").exists()

    rows = list(csv.DictReader((folder / "batch.csv").open()))
    assert [row["state"] for row in rows] == ["finished before", "finished", "failed", "failed"]
    assert float(rows[1]["psnr"]) == json.loads((finished / "metrics.json").read_text())["refined"]["held_out"]["psnr"]
    page = (folder / "index.html").read_text()
    for name in ("done", "new"):
        assert f'<a href="../maps/{name}/report.html">{name}</a>' in page
    assert "no such file" in page

    # The same command again, and once more where nothing is left but the storage.
    kept = times(maps)
    again = scene_files(recordings)[:2]
    with LocalPool(folder / "logs") as pool:
        results = run_batch(with_store(read_scenes(again, ["snapshot_every=2"]), f"file://{store}"), pool, folder)
    assert [(result.state, result.attempts) for result in results] == [(State.before, 0)] * 2
    assert times(maps) == kept
    shutil.rmtree(maps / "new")
    with LocalPool(folder / "logs") as pool:
        results = run_batch(with_store(read_scenes(again[1:]), f"file://{store}"), pool, folder)
    assert [(result.state, result.attempts) for result in results] == [(State.before, 0)]
    assert (maps / "new" / "splats.ply").read_bytes() == (finished / "splats.ply").read_bytes()


def test_the_command_says_which_scenes_are_finished_by_its_exit_code(recordings: Path) -> None:
    done, gone = recordings / "done" / "scene.yaml", recordings / "gone.yaml"
    for named, code, states in (
        ([done, done], 0, ["finished before"]),
        ([done, gone], 1, ["finished before", "failed"]),
    ):
        arguments = ["batch", *map(str, named), "-o", str(recordings / "batch"), "--json", "--quiet"]
        result = CliRunner().invoke(app, arguments)
        data = json.loads(result.stdout)
        assert (result.exit_code, data["exit_code"], result.stderr) == (code, code, "")
        assert [row["state"] for row in data["scenes"]] == states


@pytest.mark.slow
def test_a_fault_after_a_scene_is_finished_is_told(recordings: Path) -> None:
    said = io.StringIO()
    console = Console(file=said, width=200)
    scenes = read_scenes(scene_files(recordings)[1:2], ["export.report=false", "refine.steps=0"])
    with FaultyPool(recordings / "logs", jobs=1) as pool:
        results = run_batch(scenes, pool, recordings / "batch", console=console)
    assert [result.state for result in results] == [State.finished]
    assert "KeyError" in said.getvalue()


def test_what_cannot_be_written_is_refused_before_anything_begins(recordings: Path) -> None:
    (recordings / "file").touch()
    before = times(recordings)
    with LocalPool(recordings / "logs") as pool, pytest.raises(InputError, match="file/batch: cannot be written"):
        run_batch(read_scenes(scene_files(recordings)), pool, recordings / "file" / "batch")
    arguments = ["batch", str(recordings / "done" / "scene.yaml"), "-o", str(recordings / "batch"), "--store"]
    for url in (f"file://{recordings}/file/store", "nonsense://bucket"):
        result = CliRunner().invoke(app, [*arguments, url])
        assert (result.exit_code, result.stdout) == (2, "")
        assert result.stderr.startswith(f"error: {url}: cannot be ") and result.stderr.count("\n") == 1
    assert times(recordings) == before


@pytest.mark.parametrize(
    ("shares", "device", "machines", "scenes", "expected"),
    [
        (Shares(), "cpu", [8.0], 3, Resources(2.0)),
        (Shares(), "cpu", [8.0], 20, Resources(1.0)),
        (Shares(), "auto", [8.0, 4.0], 2, Resources(4.0)),
        (Shares(), "cpu", [], 2, Resources(1.0)),
        (Shares(cpus=3.0, memory=5), "cpu", [2.0], 2, Resources(3.0, 0.0, 5)),
        (Shares(), "cuda", [8.0], 8, Resources(1.0, 1.0)),
        (Shares(gpus=0.5), "auto", [8.0], 8, Resources(1.0, 0.5)),
    ],
)
def test_scenes_share_the_cores_unless_told_otherwise(
    recordings: Path, shares: Shares, device: str, machines: list[float], scenes: int, expected: Resources
) -> None:
    (scene,) = read_scenes([recordings / "done" / "scene.yaml"], [f"device={device}"])
    assert scene.config is not None
    assert shares.of(scene.config, machines, scenes) == expected

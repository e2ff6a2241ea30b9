"""A run that is stopped on its way, wherever, and resumed ends as one in peace; what cannot be resumed is refused."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.engine.resume import Recovery, load_resumed
from modp_ti.engine.session import run_scene
from modp_ti.engine.snapshot import FILE, Position, Snapshot
from modp_ti.files.errors import InputError
from tests.modp_ti.engine.stopped_runs import kill, press_ctrl_c, resumed_run, stopped_run
from tests.modp_ti.engine.test_session import psnr_of_pictures
from tests.room import Room, RoomRecording, pinhole, walk

pytestmark = pytest.mark.usefixtures("without_warm_up")

# Exposure and pruning; corrections come from klt, below: all that a snapshot must hold.
SCENE = """
source:  {path: images, holdout: 4, fps: 10}
tracker: {kind: colmap, path: sparse/0}
output:  out
device:  cpu
seed:    3
mapping: {optimise: {steps: 3}, densify: {warm_up: 3, prune_every: 4}, exposure: {enabled: true}}
refine:  {steps: 9}
export:  {report: false}
snapshot_every: 2
"""
KLT = """
source:  {path: images, holdout: 8, fps: 10, intrinsics: {fx: 120, fy: 120, cx: 80, cy: 60}}
tracker: {kind: klt}
output:  out
device:  cpu
mapping: {optimise: {steps: 2}}
refine:  {steps: 4}
export:  {report: false}
snapshot_every: 3
"""
SAME = ("splats.ply", "trajectory.txt", "exposure.json", "frames.json", "scores.csv")
FIGURES = ("frames", "keyframes", "gaussians", "corrections", "online", "refined", "guards", "frames_left_out")


@pytest.fixture(scope="module")
def in_peace(made_once: Callable[[str, Callable[[Path], None]], Path], room: Room) -> Path:
    """The output folder of a run that nobody stopped, next to its scene."""

    def fill(folder: Path) -> None:
        gains = np.exp(0.3 * np.sin(np.arange(14)))
        RoomRecording(room, pinhole(64, 48), walk(14)).write(folder, gains=gains)
        model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))  # georeferenced: its origin must be kept too
        model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array([452_000.0, 5_411_000.0, 430.0])))
        model.write_binary(str(folder / "sparse" / "0"))
        (folder / "scene.yaml").write_text(SCENE)
        run_scene(load_scene(folder / "scene.yaml"))

    return made_once(SCENE, fill) / "out"


@pytest.fixture
def scene(in_peace: Path, tmp_path: Path) -> Path:
    """The same scene with the same images, in another folder."""
    for name in ("images", "sparse"):
        (tmp_path / name).symlink_to(in_peace.parent / name)
    return Path(shutil.copy(in_peace.parent / "scene.yaml", tmp_path))


def assert_the_same(out: Path, peace: Path) -> None:
    assert set(os.listdir(out)) == set(os.listdir(peace))
    for name in set(SAME) & set(os.listdir(peace)):
        assert (out / name).read_bytes() == (peace / name).read_bytes(), name
    figures, expected = (json.loads((folder / "metrics.json").read_text()) for folder in (out, peace))
    assert {name: figures[name] for name in FIGURES} == {name: expected[name] for name in FIGURES}
    assert expected["snapshots"]["resumed"] == 0 < figures["snapshots"]["resumed"]


@pytest.mark.slow
@pytest.mark.usefixtures("interruptible")
def test_a_run_that_is_killed_and_interrupted_on_its_way_ends_as_one_in_peace(
    scene: Path, in_peace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = scene.parent / "out"
    resume = partial(resumed_run, out)
    stopped_run(monkeypatch, lambda: run_scene(load_scene(scene)), "mapping", 7, kill)
    assert Snapshot.read(out / FILE).position.events == 6 and not (out / "splats.ply").exists()

    said = str(stopped_run(monkeypatch, resume, "mapping", 3, press_ctrl_c))
    assert f"--resume {out}" in said
    assert Snapshot.read(out / FILE).position.events == 9
    assert {"splats.ply", "trajectory.txt", "frames.json", "colmap", "config.yaml"} <= set(os.listdir(out))
    assert not (out / "metrics.json").exists()

    stopped_run(monkeypatch, resume, "refining", 8, kill)
    assert Snapshot.read(out / FILE).position.refined == 6

    said = str(stopped_run(monkeypatch, resume, "evaluating the saved map", 1, press_ctrl_c))
    assert f"--resume {out}" in said and not (out / "metrics.json").exists()
    for name in ("splats.ply", "trajectory.txt"):
        assert (out / name).read_bytes() == (in_peace / name).read_bytes()

    assert_the_same(resume(), in_peace)
    assert not (out / FILE).exists()
    with pytest.raises(InputError, match="nothing to resume"):
        load_resumed(out, None, [])


@pytest.mark.slow
def test_estimated_exposures_are_written_and_the_scores_are_those_of_the_developed_pictures(in_peace: Path) -> None:
    frames = json.loads((in_peace / "exposure.json").read_text())["frames"]
    assert len(frames) == 14
    assert np.ptp(np.array([frame["matrix"] for frame in frames]), axis=0).max() > 0.01
    metrics = json.loads((in_peace / "metrics.json").read_text())
    assert metrics["refined"]["held_out"]["psnr"] == pytest.approx(psnr_of_pictures(in_peace / "renders"), abs=0.01)


@pytest.mark.slow
def test_a_tracker_that_finds_the_poses_itself_finds_them_again(
    tmp_path: Path, room: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    RoomRecording(room, pinhole(160, 120), walk(40)).write(tmp_path)
    fx = pinhole(160, 120).fx
    (tmp_path / "scene.yaml").write_text(KLT.replace("120,", f"{fx},", 1).replace("fy: 120", f"fy: {fx}"))

    def start() -> Path:
        return run_scene(load_scene(tmp_path / "scene.yaml"))

    peace = start().rename(tmp_path / "peace")
    assert json.loads((peace / "metrics.json").read_text())["corrections"]["received"] > 0
    stopped_run(monkeypatch, start, "mapping", 20, kill)
    assert_the_same(resumed_run(tmp_path / "out"), peace)


# ---- settings ----------------------------------------------------------------------------------------------------


@pytest.fixture
def stopped(tmp_path: Path) -> Path:
    """The output folder of a run of which nothing but a snapshot is known: its settings are real, its map is not."""
    (tmp_path / "scene.yaml").write_text(SCENE)
    config = load_scene(tmp_path / "scene.yaml")
    (tmp_path / "out").mkdir()
    file = tmp_path / "out" / FILE
    Snapshot(file, config.resolved(1.0).model_dump(mode="json"), Position(1, 5), {"a": np.zeros(1)}, {}).write(file)
    return tmp_path / "out"


def test_the_settings_come_from_the_snapshot_and_some_may_change(stopped: Path) -> None:
    config, snapshot = load_resumed(stopped, None, ["threads=1", "snapshot_every=5", "export.report=true"])
    assert (config.seed, config.threads, config.snapshot_every, config.export.report) == (3, 1, 5, True)
    assert config.output == stopped and snapshot is not None and snapshot.position.digest == 5
    of_scene, _ = load_resumed(stopped, stopped.parent / "scene.yaml", [])
    assert of_scene.source.scale == config.source.scale == 1.0, "what auto became"
    moved = stopped.rename(stopped.with_name("moved"))
    assert load_resumed(moved, None, [])[0].output == moved


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("mapping.optimise.steps=5", "mapping.optimise.steps: 3, not 5"),
        ("seed=4", "seed: 3, not 4"),
        ("source.scale=0.5", "source.scale: 1.0, not 0.5"),
        ("refine.steps=10", "refine.steps: 9, not 10"),
    ],
)
def test_a_snapshot_of_another_scene_is_refused_with_what_differs(stopped: Path, change: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_resumed(stopped, stopped.parent / "scene.yaml", [change])


def test_what_cannot_be_resumed_is_refused(stopped: Path, tmp_path: Path) -> None:
    snapshot = Snapshot.read(stopped / FILE)
    snapshot.settings["mapping"]["magic"] = 1
    snapshot.write(stopped / FILE)
    with pytest.raises(InputError, match=r"mapping\.magic"):
        load_resumed(stopped, None, [])
    with pytest.raises(InputError, match="no such folder"):
        load_resumed(tmp_path / "gone", None, [])
    with pytest.raises(InputError, match="there is no snapshot"):
        load_resumed(tmp_path, None, [])


def test_what_a_killed_live_run_has_kept_is_not_written_over(tmp_path: Path) -> None:
    live = SimpleNamespace(kept={"source": {"stream": None, "path": str(tmp_path)}})
    (tmp_path / "scene.yaml").write_text("source: {stream: 0}\ntracker: {kind: klt}\noutput: out\n")
    config = load_scene(tmp_path / "scene.yaml")
    first = Recovery(config, live)
    first.write()
    assert load_resumed(tmp_path / "out", None, [])[0].source.path == tmp_path
    with pytest.raises(InputError, match="--resume"):
        Recovery(config, live).write()
    first.remove()
    assert not (tmp_path / "out" / "recording.yaml").exists()

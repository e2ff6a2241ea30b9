"""A run that was stopped goes on as if it had not been: real processes, killed and interrupted, and real files."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest

from modp_ti.engine.resume import load_resumed
from modp_ti.engine.snapshot import FILE, Position, Snapshot
from modp_ti.files.errors import InputError
from tests.modp_ti.runs import finished_run
from tests.patience import PATIENCE

if TYPE_CHECKING:
    from tests.room import Room

pytestmark = pytest.mark.slow

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
SAME = ("splats.ply", "trajectory.txt", "exposure.json", "frames.json", "scores.csv")
FIGURES = ("frames", "keyframes", "gaussians", "corrections", "online", "refined", "guards", "frames_left_out")


@pytest.fixture(scope="module")
def in_peace(tmp_path_factory: pytest.TempPathFactory, room: Room) -> Path:
    from tests.room import RoomRecording, pinhole, walk

    folder = tmp_path_factory.mktemp("peace")
    RoomRecording(room, pinhole(64, 48), walk(14)).write(folder, gains=np.exp(0.3 * np.sin(np.arange(14))))
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))  # georeferenced: its origin must be kept too
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array([452_000.0, 5_411_000.0, 430.0])))
    model.write_binary(str(folder / "sparse" / "0"))
    return finished_run(folder, SCENE, "device: CPU")


@pytest.fixture
def scene(in_peace: Path, tmp_path: Path) -> Path:
    """The same scene with the same images, in a folder of its own."""
    for name in ("images", "sparse"):
        (tmp_path / name).symlink_to(in_peace.parent / name)
    return Path(shutil.copy(in_peace.parent / "scene.yaml", tmp_path))


def start(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "modp_ti.run", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Where the tests run in a shell's background, children inherit that Ctrl-C is ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def position(file: Path) -> tuple[int, int]:
    """Frames and corrections taken in, and steps of refinement, of the snapshot; (-1, -1) without one."""
    try:
        found = Snapshot.read(file).position
    except InputError:  # there is none, or the run replaced it while it was read
        return -1, -1
    return found.events, found.refined


def stop_midway(
    arguments: list[str], out: Path, reached: Callable[[], bool], by: signal.Signals, most: int = 99
) -> tuple[str, str]:
    """Run and send a signal as soon as `reached`; returns what the process wrote to stdout and stderr.

    On a busy machine the run may have passed event `most`, or be over, before this process looks again. It is then
    repeated from the files that it began with, at most ten times.
    """
    before = out.with_name("before")
    for _ in range(10):
        shutil.rmtree(before, ignore_errors=True)
        if out.exists():
            shutil.copytree(out, before)
        process = start(*arguments)
        while process.poll() is None and not reached():
            time.sleep(0.002)
        process.send_signal(by)
        said, errors = process.communicate(timeout=PATIENCE)
        assert process.returncode in (0, 130, -by), errors
        if process.returncode != 0 and 0 <= position(out / FILE)[0] <= most:
            return said, errors
        shutil.rmtree(out, ignore_errors=True)
        if before.exists():
            before.rename(out)
    raise AssertionError("the run was always over before it could be stopped")


def assert_the_same(out: Path, peace: Path) -> None:
    assert set(os.listdir(out)) == set(os.listdir(peace))
    for name in set(SAME) & set(os.listdir(peace)):
        assert (out / name).read_bytes() == (peace / name).read_bytes(), name
    figures, expected = (json.loads((folder / "metrics.json").read_text()) for folder in (out, peace))
    assert {name: figures[name] for name in FIGURES} == {name: expected[name] for name in FIGURES}
    assert expected["snapshots"]["resumed"] == 0 < figures["snapshots"]["resumed"]


def assert_resumed_ends_the_same(out: Path, peace: Path) -> None:
    process = start("--resume", str(out))
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, errors
    assert_the_same(out, peace)


def test_a_finished_run_keeps_no_snapshot(in_peace: Path) -> None:
    assert not (in_peace / FILE).exists()
    assert json.loads((in_peace / "metrics.json").read_text())["snapshots"]["written"] >= 7
    with pytest.raises(InputError, match="this run is finished; there is nothing to resume"):
        load_resumed(in_peace, None, [])


def test_a_run_that_is_killed_and_interrupted_on_its_way_ends_as_one_in_peace(scene: Path, in_peace: Path) -> None:
    out = scene.parent / "out"
    file = out / FILE
    stop_midway([str(scene)], out, lambda: position(file)[0] >= 6, signal.SIGKILL, most=12)
    before = position(file)

    said, errors = stop_midway(
        ["--resume", str(out), "--json"], out, lambda: position(file)[0] > before[0], signal.SIGINT
    )
    assert f"modp-ti run --resume {out} goes on" in json.loads(said)["error"], errors
    assert position(file) > before
    assert {"splats.ply", "trajectory.txt", "frames.json", "colmap", "config.yaml"} <= set(os.listdir(out))
    assert not (out / "metrics.json").exists()

    stop_midway(["--resume", str(out)], out, lambda: position(file)[1] >= 6, signal.SIGKILL)  # while it refines

    assert_resumed_ends_the_same(out, in_peace)
    assert not file.exists()


def test_a_run_that_is_interrupted_while_it_is_scored_keeps_its_map_and_is_scored_later(
    scene: Path, in_peace: Path
) -> None:
    out = scene.parent / "out"
    _, errors = stop_midway([str(scene)], out, lambda: any(out.glob(".modp-ti/new-*/splats.ply")), signal.SIGINT)
    assert "resume" in errors
    assert not (out / "metrics.json").exists()
    for name in ("splats.ply", "trajectory.txt"):
        assert (out / name).read_bytes() == (in_peace / name).read_bytes()

    assert_resumed_ends_the_same(out, in_peace)


def test_a_tracker_that_finds_the_poses_itself_finds_them_again(tmp_path: Path, room: Room) -> None:
    from tests.room import RoomRecording, pinhole, walk

    camera = pinhole(160, 120)
    RoomRecording(room, camera, walk(40)).write(tmp_path)
    scene = f"""
source:  {{path: images, holdout: 8, fps: 10, intrinsics: {{fx: {camera.fx}, fy: {camera.fy}, cx: 80, cy: 60}}}}
tracker: {{kind: klt}}
output:  out
device:  cpu
mapping: {{optimise: {{steps: 2}}}}
refine:  {{steps: 4}}
export:  {{report: false}}
snapshot_every: 3
"""
    peace = finished_run(tmp_path, scene, "device: CPU").rename(tmp_path / "peace")
    assert json.loads((peace / "metrics.json").read_text())["corrections"]["received"] > 0
    out = tmp_path / "out"
    stop_midway([str(tmp_path / "scene.yaml")], out, lambda: position(out / FILE)[0] >= 6, signal.SIGKILL)
    assert_resumed_ends_the_same(out, peace)


@pytest.fixture
def stopped(tmp_path: Path) -> Path:
    """The output folder of a run of which nothing but a snapshot is known: its settings are real, its map is not."""
    from modp_ti.config.scene_file import load_scene

    (tmp_path / "scene.yaml").write_text(SCENE)
    config = load_scene(tmp_path / "scene.yaml")
    (tmp_path / "out").mkdir()
    file = tmp_path / "out" / FILE
    Snapshot(file, config.resolved(1.0).model_dump(mode="json"), Position(1, 5), {"a": np.zeros(1)}, {}).write(file)
    return tmp_path / "out"


def test_the_settings_come_from_the_snapshot_and_some_may_change(stopped: Path) -> None:
    config, snapshot = load_resumed(stopped, None, ["threads=1", "snapshot_every=5", "export.report=true"])
    assert (config.seed, config.threads, config.snapshot_every, config.export.report) == (3, 1, 5, True)
    assert config.output == stopped and snapshot.position.digest == 5


def test_an_output_folder_that_was_moved_is_written_where_it_is_now(stopped: Path) -> None:
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
    with pytest.raises(InputError, match=f"the snapshot was made with {said}"):
        load_resumed(stopped, stopped.parent / "scene.yaml", [change])


def test_the_scale_that_auto_became_is_kept(stopped: Path) -> None:
    config, _ = load_resumed(stopped, stopped.parent / "scene.yaml", [])
    assert config.source.scale == load_resumed(stopped, None, [])[0].source.scale == 1.0


def test_settings_that_this_version_does_not_have_are_refused(stopped: Path) -> None:
    snapshot = Snapshot.read(stopped / FILE)
    snapshot.settings["mapping"]["magic"] = 1
    snapshot.write(stopped / FILE)
    with pytest.raises(InputError, match=r"unknown key `mapping\.magic`"):
        load_resumed(stopped, None, [])


def test_a_folder_without_a_snapshot_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        load_resumed(tmp_path / "gone", None, [])
    with pytest.raises(InputError, match="there is no snapshot; start the run from its scene"):
        load_resumed(tmp_path, None, [])

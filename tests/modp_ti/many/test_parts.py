"""A recording is cut in parts, and its parts make one map, whatever the order in which they end."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fields.geometry.camera import PinholeCamera
from modp_ti.commands.app import app
from modp_ti.config.scene_file import load_scene
from modp_ti.engine.parts import MARGIN, SEES_TOO, SLACK, cut
from modp_ti.files.errors import InputError
from modp_ti.many import parts as mapping
from modp_ti.many.results import SceneResult, State
from modp_ti.outputs.playback.finished_run import open_run
from pipelines.select.keyframes import SeenPoints, covisibility
from tests.modp_ti.runs import FILES
from tests.room import Room, RoomRecording, pinhole, walk

FRAMES = 16

SCENE = """
source:  {path: images, holdout: 5, fps: 10}
tracker: {kind: colmap, path: sparse/0}
output:  out
device:  cpu
threads: 1
mapping: {optimise: {steps: 4}, densify: {warm_up: 3}}
refine:  {steps: 25}
export:  {report: false}
"""

SAME = ("splats.ply", "trajectory.txt", "frames.json", "scores.csv", "config.yaml")


@pytest.fixture
def scene(room: Room, tmp_path: Path) -> Path:
    RoomRecording(room, pinhole(80, 60), walk(FRAMES)).write(tmp_path)
    file = tmp_path / "scene.yaml"
    file.write_text(SCENE)
    return file


def invoke(*arguments: str | Path) -> str:
    result = CliRunner().invoke(app, ["run", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    return result.stderr


def times(folder: Path) -> Mapping[Path, int]:
    return {file: file.stat().st_mtime_ns for file in folder.rglob("*") if file.is_file()}


@pytest.mark.slow
def test_two_parts_make_one_map(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(scene.parent / "no-torch"))
    out = scene.parent / "out"
    said = invoke(scene, "--parts", "2")
    assert "part-1: finished" in said and "merging the maps of 2 parts" in said

    # The output folder is that of an ordinary run, with the parts below it.
    assert sorted(path.name for path in out.iterdir()) == sorted({*FILES, "parts"} - {"report.html"})
    metrics = json.loads((out / "metrics.json").read_text())
    run, parts = open_run(out), metrics["parts"]
    assert run.names == [f"{i:04d}.png" for i in range(FRAMES)]
    assert run.record.held_out == [0, 5, 10, 15]
    assert [part["own"] for part in parts] == [[0, parts[0]["own"][1]], [parts[0]["own"][1], FRAMES]]
    assert metrics["online"]["gaussians"] == sum(part["kept"] for part in parts)
    assert all(0 < part["kept"] <= part["gaussians"] for part in parts)
    assert metrics["refined"]["held_out"]["psnr"] > metrics["online"]["held_out"]["psnr"], "the seams are refined"
    # A keyframe gets four steps of six views and two last ones, at least 48 in all, and 25 steps of four views follow.
    # What the parts have not rendered of them, nor merging, is left to the refinement.
    views = metrics["keyframes"] * 4 * 6 + 48
    of_parts = [json.loads((out / f"parts/{number}/metrics.json").read_text())["online"] for number in (1, 2)]
    assert metrics["online"]["view_renders"] > sum(of_part["view_renders"] for of_part in of_parts)
    steps = 25 + (views - metrics["online"]["view_renders"]) // 4
    renders = metrics["refined"]["view_renders"] - metrics["online"]["view_renders"]
    assert 4 * steps <= renders <= 4 * steps + FRAMES  # each keyframe also once, for hidden Gaussians
    for number in (1, 2):
        first, end = parts[number - 1]["frames"]
        part = open_run(out / "parts" / str(number))
        assert load_scene(part.folder / "config.yaml").mapping.optimise.steps == 1
        assert part.names == run.names[first:end]
        assert [first + line for line in part.record.held_out] == [i for i in (0, 5, 10, 15) if first <= i < end]

    # The same command maps no part again. A part that is lost is mapped after the other one, to the same bytes.
    kept = {name: (out / name).read_bytes() for name in SAME}
    shutil.rmtree(out / "parts" / "1")
    (out / "splats.ply").unlink()
    before = times(out / "parts" / "2")
    said = invoke(scene, "--parts", "2")
    assert "part-1: finished" in said and "part-2: finished before" in said
    assert times(out / "parts" / "2") == before
    assert {name: (out / name).read_bytes() for name in SAME} == kept


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--set", "tracker={kind: klt}"], "parts cannot be combined with tracker.kind: klt"),
        (["--address", "here:1"], "--address is for --engine ray"),
        (["--parts", "5"], "the recording has 16 frames, too few for 5 parts: take at most 2 parts"),
    ],
)
def test_what_cannot_be_cut_is_refused_in_one_line(scene: Path, arguments: list[str], said: str) -> None:
    result = CliRunner().invoke(app, ["run", str(scene), "--parts", "2", *arguments])
    assert (result.exit_code, result.stdout) == (2, "")
    assert said in result.stderr and result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    assert not (scene.parent / "out" / "metrics.json").exists()


def test_a_part_that_fails_is_named_with_its_reason(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failed = SceneResult("part-2", "", None, State.failed, error="its disk is full")
    monkeypatch.setattr(
        mapping, "run_batch", lambda *_, **__: [replace(failed, name="part-1", state=State.before), failed]
    )
    result = CliRunner().invoke(app, ["run", str(scene), "--parts", "2"])
    assert result.exit_code == 2 and result.stderr.startswith("error: part-2: its disk is full")


CAMERA = PinholeCamera(60.0, 60.0, 40.0, 30.0, 80, 60)


def along_walls(frames: int, step: float = 0.05, door: int | None = None) -> list[SeenPoints]:
    """Views of a wall by a camera that moves along it. At the frame `door`, it comes to another wall far away."""
    wall = np.stack([*np.meshgrid(np.arange(-3.0, 200.0, 0.25), np.arange(-1.0, 1.1, 0.5))], axis=-1).reshape(-1, 2)
    views = []
    for index in range(frames):
        T = np.eye(4)
        T[0, 3] = -step * index - (100.0 if door is not None and index >= door else 0.0)
        seen = np.column_stack([wall, np.full(len(wall), 2.0)])
        local = seen + T[:3, 3]
        views.append(SeenPoints(CAMERA, T, seen[CAMERA.contains(CAMERA.project(local))]))
    return views


@pytest.mark.parametrize(("frames", "parts"), [(16, 2), (100, 2), (101, 4), (97, 7)])
def test_every_frame_belongs_to_one_part_of_about_the_same_length(frames: int, parts: int) -> None:
    found = cut(along_walls(frames), parts)
    assert [part.number for part in found] == list(range(1, parts + 1))
    assert [frame for part in found for frame in part.own] == list(range(frames))
    longest = frames / parts
    assert max(abs(len(part.own) - longest) for part in found) <= 2 * SLACK * longest + 1


def test_neighbours_share_the_frames_around_a_cut_and_no_others() -> None:
    views = along_walls(200)
    found = cut(views, 4)
    most = max(int(MARGIN * 50), 1)
    assert (found[0].frames.start, found[-1].frames.stop) == (0, 200)
    for before, after in pairwise(found):
        assert before.own.stop == after.own.start
        for beyond in (before.frames.stop - before.own.stop, after.own.start - after.frames.start):
            assert beyond == most
    # A fast camera sees less of what is at the cut.
    for part in cut(along_walls(200, step=0.5), 4)[1:]:
        for frame in range(part.frames.start, part.own.start):
            assert (
                covisibility(along_walls(200, step=0.5)[frame], along_walls(200, step=0.5)[part.own.start]) >= SEES_TOO
            )
        assert part.own.start - part.frames.start < most


@pytest.mark.parametrize("door", [46, 50, 54])
def test_a_cut_is_made_where_the_camera_comes_to_another_place(door: int) -> None:
    first, second = cut(along_walls(100, door=door), 2)
    assert (first.own.stop, second.own.start) == (door, door)
    assert (first.frames, second.frames) == (first.own, second.own), "neither sees what the other sees"


def test_a_recording_that_is_too_short_is_refused_with_what_would_do() -> None:
    with pytest.raises(InputError, match="has 20 frames, too few for 3 parts: take at most 2 parts"):
        cut(along_walls(20), 3)
    with pytest.raises(InputError, match="has 9 frames, too few for 2 parts: take no parts"):
        cut(along_walls(9), 2)

"""The benchmark's figures are those of what it measures, and its tables say what they should."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import benchmark
import numpy as np
import pytest
import quality
import torch
import versions
from quality import Point, frontier, points_of, psnr_at, seconds_to
from step import (
    ADAM_BYTES,
    BACKWARD_FLOPS,
    FORWARD_FLOPS,
    STAGES,
    Size,
    add_gaussians,
    arrays,
    camera_of,
    device_calls,
    measure_step,
    noise_frame,
)

from fields.buffers.tiles import TILE_WIDTH
from fields.map.gaussians import GaussianField
from fields.runtime.backend import initialise
from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from pipelines.render.renderer import Renderer

SMALL = Size(96, 64, 300)


def test_operations_are_counted_and_views_are_not() -> None:
    values = torch.rand(8)
    assert device_calls(lambda: torch.cumsum(torch.sort(values[2:]).values.view(3, 2), 0)) == 2


@pytest.mark.slow
def test_a_step_is_measured_by_stage_and_its_pairs_are_counted() -> None:
    figures = measure_step("cpu", 2, SMALL, repeats=2)
    assert all(figures[name] > 0 for name in (*STAGES, "step", "host", "calls", "peak_memory_mb"))

    # Independent of the lists' rows: pixels of the tiles' rows that an alpha above the threshold touches are visited.
    initialise("cpu", 1)
    gaussians = GaussianField()
    add_gaussians(gaussians, SMALL)
    renderer = Renderer(gaussians, SMALL.width, SMALL.height)
    frame = noise_frame(SMALL.width, SMALL.height)
    renderer.forward(frame.camera, frame.T_camera_world, 0.01)
    touched = 0
    for s in range(renderer.projected.count):
        mean, conic = renderer.projected.mean[s], renderer.projected.conic[s]
        y, x = np.mgrid[: SMALL.height, : SMALL.width] + 0.5
        dx, dy = x - mean[0], y - mean[1]
        power = -0.5 * (conic[0] * dx * dx + conic[2] * dy * dy) - conic[1] * dx * dy
        drawn = renderer.projected.opacity[s] * np.exp(power) >= 1 / 255
        rows = drawn.reshape(SMALL.height, -1, TILE_WIDTH).any(axis=2)
        touched += int(np.count_nonzero(rows)) * TILE_WIDTH
    assert figures["visible"] == renderer.projected.count
    # Rows between the first and the last that it touches count too, as do those that it only just misses.
    assert touched <= figures["pairs visited"] <= 1.1 * touched
    assert 0.0 < figures["cores_had"] <= 2.05


@pytest.mark.slow
def test_the_scene_lies_in_the_picture() -> None:
    camera = camera_of(SMALL.width, SMALL.height)
    position = arrays(SMALL)["position"]
    assert camera.contains(camera.project(position)).all() and position[:, 2].min() >= 2.0


def made_up(kind: str, **arguments: Any) -> dict[str, Any]:
    """Figures from which the tables' numbers can be told by hand."""
    threads = arguments.get("threads", 1)
    if kind == "machine":
        return {"gflops": 100.0 * threads, "gigabytes_per_second": 20.0}
    figures = dict.fromkeys(STAGES, 4.0 / threads)
    figures |= {"step": 40.0 / threads, "pairs visited": 1e6, "visible": 1000}
    return figures | {"peak_memory_mb": 321.0, "cores_had": 0.9 * threads}


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["benchmark.py", *arguments])
    benchmark.main()


@pytest.fixture
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "in_process", made_up)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)


@pytest.mark.slow
def test_the_tables_say_what_was_measured(monkeypatch, two_cores, tmp_path: Path, capsys) -> None:
    run(monkeypatch, "--quick", "-o", str(tmp_path))
    text = (tmp_path / "benchmark.md").read_text()
    assert capsys.readouterr().out == text
    assert "1.00 million pixel-Gaussian pairs visited" in text
    assert "Cores at work in a step: 0.90 with 1 thread, 1.80 with 2 threads;" in text
    assert "| **whole step** | 40.00 | 20.00 | 2.00 | – | – |" in text
    # A million pairs in so many milliseconds, of 100 and 200 GFLOP/s.
    one, two = FORWARD_FLOPS / 4.0 / 100 * 100, BACKWARD_FLOPS / 2.0 / 200 * 100
    assert f"| compositing | 4.00 | 2.00 | 2.00 | {one:.0f} | " in text
    assert re.search(rf"\| compositing backward \| .* \| {two:.0f} \|", text)
    rate = ADAM_BYTES * 1000 / 4e-3 / 1e9
    assert f"| Adam | 4.00 | 2.00 | 2.00 | {5 * rate:.0f} | {10 * rate:.0f} |" in text
    assert "Whole runs" not in text
    figures = json.loads((tmp_path / "benchmark.json").read_text())
    assert figures["machine"]["2"]["gflops"] == 200.0
    assert figures["steps"][0]["size"] == {"width": 270, "height": 480, "gaussians": 12_500}


@pytest.mark.slow
def test_whole_runs_are_those_of_the_scenes_that_are_named(
    monkeypatch, two_cores, scene: Path, started: list[SceneConfig], capsys
) -> None:
    run(monkeypatch, "--scene", str(scene), "--set", "seed=5")
    text = capsys.readouterr().out
    (config,) = started
    assert (config.source.path, config.seed, config.refine.steps) == (load_scene(scene).source.path, 5, 0)
    assert text.count("pixel-Gaussian pairs visited") == 3
    name = scene.parent.name
    assert f"| {name} | 9 | 5 | 1,000 | 0.18 | 10.0 | 2.00 | 700 | 21.00 |" in text


@pytest.mark.slow
def test_bad_input_gets_one_line_and_exit_code_two_before_anything_is_measured(monkeypatch, capsys) -> None:
    monkeypatch.setattr(benchmark, "in_process", lambda *_, **__: pytest.fail("measured"))
    with pytest.raises(SystemExit) as ended:
        run(monkeypatch, "--scene", "gone.yaml")
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and "gone.yaml" in error


def point(seconds: float, psnr: float, stage: str = "online", steps: int = 1) -> Point:
    return Point(steps, stage, seconds, psnr, 0.9, 0.8, psnr + 1, None, 1000, 5000)


def test_processor_time_is_divided_as_the_stages_of_the_run(make_metrics: Callable[..., dict]) -> None:
    # 100 s in all, of which 10 compile, 5 evaluate and 30 refine.
    online, refined = points_of(make_metrics(20.0, refined=21.0), processor=200.0, steps=4)
    assert (online.stage, online.seconds, online.psnr, online.view_renders) == ("online", 110.0, 20.0, 1000)
    assert (refined.stage, refined.seconds, refined.psnr, refined.steps) == ("refined", 170.0, 21.0, 4)
    assert [p.stage for p in points_of(make_metrics(20.0), 200.0, 4)] == ["online"]


def test_the_frontier_leaves_out_what_another_point_beats() -> None:
    points = [point(40.0, 24.0), point(10.0, 20.0), point(20.0, 19.0), point(80.0, 24.0)]
    assert frontier(points) == ([10.0, 40.0], [20.0, 24.0])


def test_quality_and_time_are_read_off_the_same_curve() -> None:
    points = [point(10.0, 20.0), point(40.0, 24.0)]
    assert psnr_at(points, 9.0) is None
    assert psnr_at(points, 20.0) == pytest.approx(22.0)  # halfway in the logarithm of time
    assert psnr_at(points, 1000.0) == 24.0
    assert seconds_to(points, 22.0) == pytest.approx(20.0)
    assert seconds_to(points, 24.5) is None


def test_programs_run_interleaved_and_the_median_of_their_time_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[str] = []
    speeds = {"new": iter([30.0, 10.0, 20.0]), "old": iter([60.0] * 3)}

    def measured(root: Path, scene: Path, steps: int, settings: dict) -> list[Point]:
        started.append(root.name)
        return [point(next(speeds[root.name]), 20.0 + steps, steps=steps)]

    monkeypatch.setattr(quality, "measured", measured)
    curves = quality.curves({"room": Path("scene.yaml")}, {"a+": Path("new"), "b": Path("old")}, [4], 3, {})
    assert started == ["new", "old", "old", "new", "new", "old"]
    assert [(p.seconds, p.psnr) for p in curves["room"]["a+"]] == [(20.0, 24.0)]


def test_another_commit_is_checked_out_and_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def git(*arguments: str) -> None:
        who = ["-c", "user.name=a", "-c", "user.email=a@example.com"]
        subprocess.run(["git", "-C", str(tmp_path), *who, *arguments], check=True, capture_output=True)

    git("init")
    for text in ("first", "second"):
        (tmp_path / "file.py").write_text(text)
        git("add", ".")
        git("commit", "-m", text)
    monkeypatch.setattr(versions, "ROOT", tmp_path)
    commit = versions.this_version()
    assert not commit.endswith("+")
    (tmp_path / "file.py").write_text("third")
    assert versions.this_version() == commit + "+"
    with versions.checked_out("HEAD~1") as (_, other):
        assert (other / "file.py").read_text() == "first"
    assert not other.exists()
    with pytest.raises(InputError, match="no such revision"), versions.checked_out("nowhere"):
        pass

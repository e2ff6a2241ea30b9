from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import compare
import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError


def test_offline_gets_as_many_steps_as_the_online_run_rendered_views(scene: Path, tmp_path: Path) -> None:
    job = compare.offline_job("room", scene, tmp_path, 1234, {"seed": "3"})
    config = load_scene(scene, job.arguments())
    assert (config.mode, config.offline.steps, config.seed) == ("offline", 1234, 3)


def test_the_tables_show_what_each_map_cost(make_metrics: Callable[..., dict]) -> None:
    runs = [make_metrics(24.0, 1000, 26.0), make_metrics(24.0, 1100, 27.0, view_renders=81_000)]
    rows = compare.online_rows(runs, [1000, 20_000])
    offline = make_metrics(0.0, 3000, 25.0)
    offline |= {"online": None, "refined": None, "offline": offline["refined"]}
    offline["seconds"] |= {"total": 220.0, "refine": 0.0}
    rows[compare.OFFLINE] = compare.offline_row(offline)
    text = compare.report({"desk": rows}, {"desk": compare.time_breakdown(runs[0])})
    assert text == (
        """\
# Online and offline

Held-out frames; all frames where none is held out. Time without compiling, the tracker's preparation and evaluation.

## desk

| map | PSNR | SSIM | LPIPS | steps | # Gaussians | view renders | time [s] |
|---|---|---|---|---|---|---|---|
| online | 24.00 | 0.600 | – | 0 | 1,000 | 1,000 | 50 |
| online + 1,000 steps | 26.00 | 0.650 | – | 1,000 | 1,000 | 5,000 | 80 |
| online + 20,000 steps | 27.00 | 0.675 | – | 20,000 | 1,100 | 81,000 | 80 |
| offline 3DGS | 25.00 | 0.625 | – | 5,000 | 3,000 | 5,000 | 200 |

## Time of the online run, percent

| scene | Optim | Cam Select | Depth Est. | MOHV | Others | FPS |
|---|---|---|---|---|---|---|
| desk | 80.00 | 2.00 | 4.00 | 2.00 | 12.00 | 0.18 |"""
    )


def test_several_scenes_have_a_mean(make_metrics: Callable[..., dict]) -> None:
    runs = {"desk": make_metrics(24.0, refined=26.0), "fox": make_metrics(20.0, 3000, 21.0)}
    rows = {scene: compare.online_rows([run], [1000]) for scene, run in runs.items()}
    text = compare.report(rows, {scene: compare.time_breakdown(run) for scene, run in runs.items()})
    assert "## Mean of 2 scenes" in text
    assert "| online | 22.00 | 0.550 | – | 0 | 2,000 | 1,000 | 50 |" in text
    assert "| mean | 80.00 | 2.00 | 4.00 | 2.00 | 12.00 | 0.18 |" in text


def test_the_breakdown_of_the_metrics_is_taken_where_there_is_one(make_metrics: Callable[..., dict]) -> None:
    percent = {"optimise": 91.44, "select": 0.79, "depth": 1.63, "occupancy": 0.87, "others": 5.27}
    figures = compare.time_breakdown(make_metrics(20.0, breakdown_percent=percent))
    assert list(figures.values()) == [91.44, 0.79, 1.63, 0.87, 5.27, 0.18]


def test_metrics_without_a_count_of_renders_are_refused() -> None:
    with pytest.raises(InputError, match="--fresh"):
        compare.counts({"online": {}}, "online")


def test_the_script_runs_each_refinement_once(
    scene: Path, tmp_path: Path, started: list, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "out"
    steps = ["--steps", "1000", "200", "1000"]
    monkeypatch.setattr(sys, "argv", ["compare.py", str(scene), "-o", str(out), *steps, "--no-offline"])
    compare.main()
    assert sorted(load_scene(p).refine.steps for p in out.glob("*/*/config.yaml")) == [200, 1000]
    assert len(started) == 2
    assert (out / "comparison.md").read_text() == capsys.readouterr().out
    written = json.loads((out / "comparison.json").read_text())
    assert list(written["quality"][scene.parent.name]) == ["online", "online + 1,000 steps", "online + 200 steps"]

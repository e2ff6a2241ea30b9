"""Runs of the demo room in `mode: offline`, as a user starts them: in processes of their own."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from modp_ti.exports.splats_ply import read_splats
from modp_ti.exports.trajectory import read_trajectory
from tests.modp_ti.report.made_up_run import Page
from tests.modp_ti.runs import FILES, finished_run, run

SCENE = """
mode:    offline
source:  {scale: 0.25, holdout: 4, stop: 9, fps: 10}
tracker: {kind: synthetic}
output:  out
device:  cpu
seed:    3
offline: {steps: 90, sh_every: 3000}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of one run."""
    return finished_run(tmp_path_factory.mktemp("session"), SCENE, "9 frames, 6 keyframes")


def test_a_run_leaves_the_files_that_an_online_run_leaves(folder: Path) -> None:
    assert sorted(p.name for p in folder.iterdir()) == FILES
    assert sorted(p.name for p in (folder / "renders").iterdir()) == ["000000.png", "000004.png", "000008.png"]
    assert len(read_trajectory(folder / "trajectory.txt")[0]) == 9


def test_the_metrics_say_what_happened(folder: Path) -> None:
    metrics = json.loads((folder / "metrics.json").read_text())
    assert (metrics["frames"], metrics["keyframes"], metrics["offline"]["view_renders"]) == (9, 6, 90)
    assert metrics["online"] is metrics["refined"] is None
    assert metrics["offline"]["all"]["count"] == 9
    assert metrics["offline"]["held_out"]["count"] == 3
    assert metrics["offline"]["all"]["psnr"] > 12
    assert metrics["seconds"]["optimise"] > 0
    assert metrics["seconds"]["refine"] == metrics["seconds"]["depth"] == 0


def test_the_report_shows_how_the_map_was_optimised(folder: Path) -> None:
    page = Page((folder / "report.html").read_text(encoding="utf-8"))
    assert len(page.curves()["step-gaussians"][0]) == 90
    assert "Offline optimisation" in page.text and "Post refinement" not in page.text


def test_the_splats_have_the_harmonics_of_degree_three(folder: Path) -> None:
    sh = read_splats(folder / "splats.ply")["sh"]
    assert sh.shape == (json.loads((folder / "metrics.json").read_text())["gaussians"], 16, 3)
    # The schedule reached degree 3 after 27 of the 90 steps.
    assert np.abs(sh[:, 9:]).max() > 0


def test_the_written_configuration_gives_the_same_map_byte_for_byte(folder: Path, tmp_path: Path) -> None:
    result = run(folder / "config.yaml", "--set", f"output={tmp_path / 'again'}")
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "again" / "splats.ply").read_bytes() == (folder / "splats.ply").read_bytes()


def test_frames_without_points_are_an_error_of_one_line(tmp_path: Path) -> None:
    scene = tmp_path / "scene.yaml"
    scene.write_text(SCENE.replace("stop: 9", "stop: 1"))  # only a frame that is held out
    result = run(scene, "--quiet", "--set", "offline.sh_degree=0")
    assert result.returncode == 2
    assert result.stderr.startswith("error: `mode: offline` starts from tracked points: ")
    assert result.stderr.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["scene.yaml"]

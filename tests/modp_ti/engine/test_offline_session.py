"""Runs of a small room in `mode: offline`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.engine.session import run_scene
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.splats_ply import read_splats
from modp_ti.outputs.formats.trajectory import read_trajectory
from tests.modp_ti.outputs.report.made_up_run import Page
from tests.modp_ti.runs import FILES

if TYPE_CHECKING:
    from tests.room import RoomRecording

SCENE = """
mode:    offline
source:  {path: images, holdout: 4, fps: 10}
tracker: {kind: colmap, path: sparse/0}
output:  out
device:  cpu
seed:    3
offline: {steps: 90, sh_every: 3000}
"""
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(room_recording: RoomRecording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of one run."""
    place = tmp_path_factory.mktemp("offline")
    room_recording.write(place)
    (place / "scene.yaml").write_text(SCENE)
    return run_scene(load_scene(place / "scene.yaml"))


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
    assert metrics["offline"]["fitted"]["count"] == 6, "every frame that is not held out"
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
    again = [f"output={tmp_path / 'again'}", "evaluation.scores=false", "export.report=false"]
    run_scene(load_scene(folder / "config.yaml", again))
    assert (tmp_path / "again" / "splats.ply").read_bytes() == (folder / "splats.ply").read_bytes()


def test_frames_without_points_are_an_error_of_one_line(folder: Path, tmp_path: Path) -> None:
    # Only a frame that is held out.
    config = load_scene(folder.parent / "scene.yaml", ["source.stop=1", f"output={tmp_path / 'out'}"])
    with pytest.raises(InputError, match=r"^[^\n]+$"):
        run_scene(config)
    assert not (tmp_path / "out").exists()

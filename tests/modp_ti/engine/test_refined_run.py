"""`modp-ti refine`: the map of a finished run gets better, or stays as it was."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from modp_ti.commands.app import app
from modp_ti.engine import refined_run
from modp_ti.engine.refined_run import refine_run
from modp_ti.engine.snapshot import FILE
from modp_ti.files.run_folder import PRIVATE
from modp_ti.outputs.formats.run_files import read_scores
from modp_ti.outputs.formats.splats_ply import read_splats
from modp_ti.outputs.playback.finished_run import open_run


@pytest.fixture
def out(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished run's folder, whose map is replaced."""
    return shutil.copytree(finished, tmp_path / "out")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.slow
def test_the_map_gets_better_and_the_folder_is_that_of_a_finished_run(out: Path) -> None:
    before, run = contents(out), open_run(out)
    metrics = refine_run(out, steps=40)
    earlier = json.loads(before["metrics.json"])
    assert metrics["refined"]["held_out"]["psnr"] > earlier["refined"]["held_out"]["psnr"] + 0.1

    # The map and its figures are new, and nothing else is.
    after = contents(out)
    assert after.keys() == before.keys()
    changed = {name for name in after if after[name] != before[name] and not name.startswith("renders/")}
    assert changed == {"splats.ply", "metrics.json", "scores.csv", "report.html"}
    assert json.loads(after["metrics.json"]) == metrics
    assert metrics["refinement"]["before"] == earlier["refined"] and metrics["online"] == earlier["online"]
    scores = read_scores(out / "scores.csv")
    held_out = [score.psnr for score in scores if score.held_out and score.stage == "refined"]
    assert np.mean(held_out) == pytest.approx(metrics["refined"]["held_out"]["psnr"], abs=1e-3)
    assert len(scores) == 2 * len(run)
    assert len(read_splats(out / "splats.ply")["position"]) == metrics["gaussians"]


def test_an_interrupted_refinement_leaves_the_run_as_it_was(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(out)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(refined_run, "evaluate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        refine_run(out, steps=1)
    assert contents(out) == before
    assert [file.name for file in (out / PRIVATE).iterdir()] == ["files.json"]


def refused(folder: Path) -> bool:
    result = CliRunner().invoke(app, ["refine", str(folder)])
    return (result.exit_code, result.stdout, result.stderr.count("\n")) == (2, "", 1)


def test_what_cannot_be_refined_is_refused_in_one_line(out: Path) -> None:
    assert refused(out / "elsewhere")
    settings = (out / "config.yaml").read_text()
    (out / "config.yaml").write_text(settings.replace("mode: online", "mode: offline"))
    assert refused(out)
    (out / "config.yaml").write_text(settings)
    (out / FILE).touch()
    assert refused(out)
    (out / FILE).unlink()
    (out / "metrics.json").unlink()
    assert refused(out)

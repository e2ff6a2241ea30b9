"""`modp-ti refine`: the map of a finished run gets better, whatever the order in which its regions end."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from modp_ti.commands.app import app
from modp_ti.engine.snapshots.file import FILE
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.scores_csv import read_scores
from modp_ti.outputs.formats.splats_ply import read_splats
from modp_ti.outputs.playback.finished_run import open_run
from modp_ti.refining import refined_run
from modp_ti.refining.rounds import Plan, refine_run
from modp_ti.tasks import Answer, End, Ended, Engine, Resources, Running
from modp_ti.tasks.task import Work, perform

CHANGED = {"splats.ply", "metrics.json", "scores.csv", "report.html"}


class HereAndNow(Engine):
    """Makes calls in this process, in their order or backwards; those that are named fail."""

    def __init__(self, backwards: bool = False, failing: Sequence[str] = ()) -> None:
        self._backwards, self._failing = backwards, failing
        self._waiting: list[tuple[str, Work]] = []
        self.reports: list[tuple[int, float]] = []

    @property
    def machines(self) -> Sequence[float]:
        return [1.0]

    def submit(self, name: str, work: Work, resources: Resources) -> None:
        self._waiting.append((name, work))

    def events(self, wait: float) -> list[Running | Ended]:
        name, work = self._waiting.pop(-1 if self._backwards else 0)
        if name in self._failing:
            return [Ended(name, Answer(End.failed, error="its disk is full"))]
        told: list[Running | Ended] = []
        answer = perform(work, lambda report: told.append(Running(name, "here", report)))
        return [*told, Ended(name, answer, "here")]

    def stop(self) -> None:
        self._waiting.clear()

    def __exit__(self, *error: object) -> None:
        self._waiting.clear()


@pytest.fixture
def out(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished run's folder, whose map is replaced."""
    return shutil.copytree(finished, tmp_path / "out")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.slow
def test_the_map_gets_better_whatever_the_order_in_which_regions_end(out: Path, tmp_path: Path) -> None:
    again = shutil.copytree(out, tmp_path / "again")
    before, run = contents(out), open_run(out)
    plan = Plan(regions=2, rounds=2, steps=60)
    metrics = refine_run(out, plan, HereAndNow())
    refine_run(again, plan, HereAndNow(backwards=True))
    assert (out / "splats.ply").read_bytes() == (again / "splats.ply").read_bytes()
    assert (out / "scores.csv").read_bytes() == (again / "scores.csv").read_bytes()

    # The folder is that of a finished run, of which the map and its figures are new.
    after = contents(out)
    assert after.keys() == before.keys()
    changed = {name for name in after if after[name] != before[name]}
    assert {name for name in changed if not name.startswith("renders/")} == CHANGED
    assert json.loads((out / "metrics.json").read_text()) == metrics
    earlier = json.loads(before["metrics.json"])
    assert metrics["regions"]["before"] == earlier["refined"] and metrics["online"] == earlier["online"]
    assert metrics["refined"]["held_out"]["psnr"] > earlier["refined"]["held_out"]["psnr"] + 0.1
    scores = read_scores(out / "scores.csv")
    held_out = [score.psnr for score in scores if score.held_out and score.stage == "refined"]
    assert np.mean(held_out) == pytest.approx(metrics["refined"]["held_out"]["psnr"], abs=1e-3)
    assert len(scores) == 2 * len(run)

    # Each Gaussian has been in one region in each round.
    rounds = metrics["regions"]["rounds"]
    assert sum(region["gaussians"] for region in rounds[0]["regions"]) == earlier["gaussians"]
    assert len(read_splats(out / "splats.ply")["position"]) == metrics["gaussians"]
    assert all(region["around"] > 0 and region["views"] == len(run.mapped) for region in rounds[0]["regions"])


def test_a_run_stays_as_it_was_if_a_region_fails(out: Path) -> None:
    before = contents(out)
    with pytest.raises(InputError, match=r"^region-2: its disk is full; the run is as it was$"):
        refine_run(out, Plan(steps=2), HereAndNow(failing=["region-1", "region-2"], backwards=True))
    assert contents(out) == before


@pytest.mark.slow
def test_an_interrupted_scoring_leaves_the_run_as_it_was(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(out)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(refined_run, "evaluate", interrupted)
    with pytest.raises(KeyboardInterrupt, match="is as it was"):
        refine_run(out, Plan(regions=1, rounds=1, steps=1), HereAndNow())
    assert contents(out) == before
    assert not out.with_name("out.partial").exists()


def refused(*arguments: str | Path) -> str:
    result = CliRunner().invoke(app, ["refine", *map(str, arguments)])
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    return result.stderr


def test_what_cannot_be_refined_is_refused_in_one_line(out: Path) -> None:
    assert "no such folder; a run makes it at its end" in refused(out / "elsewhere")
    assert "--address is for --engine ray" in refused(out, "--address", "here:1")
    settings = (out / "config.yaml").read_text()
    (out / "config.yaml").write_text(settings.replace("mode: online", "mode: offline"))
    assert "an offline map is not refined: map it with more offline.steps" in refused(out)
    (out / "config.yaml").write_text(settings)
    (out / FILE).touch()
    assert f"its run has not finished: modp-ti run --resume {out.resolve()} goes on with it" in refused(out)
    (out / FILE).unlink()
    (out / "metrics.json").unlink()
    assert "its run has not finished" in refused(out)

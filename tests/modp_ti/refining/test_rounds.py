"""`modp-ti refine`: the map of a finished run gets better, whatever the order in which its regions end."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from modp_ti.commands.app import app
from modp_ti.engine.snapshots.file import FILE
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import PRIVATE
from modp_ti.outputs.formats.scores_csv import read_scores
from modp_ti.outputs.formats.splats_ply import read_splats
from modp_ti.outputs.playback.finished_run import open_run
from modp_ti.refining import refined_run, rounds
from modp_ti.refining.refined_run import RefinedMap
from modp_ti.refining.region_task import RegionJob, RegionResult
from modp_ti.refining.rounds import Plan, refine_run
from modp_ti.tasks import Ended, Engine, Resources, Running
from modp_ti.tasks.task import Work, perform
from pipelines.regions.refinement import RefinedRegion


class HereAndNow(Engine):
    """Makes calls in this process, in their order or backwards.

    Args:
        backwards: Whether the last call is made first.
        instead: Carries out the job of a call; None for the call itself.
    """

    def __init__(self, backwards: bool = False, instead: Callable[[RegionJob], RegionResult] | None = None) -> None:
        self._backwards, self._instead = backwards, instead
        self._waiting: list[tuple[str, Any]] = []

    @property
    def machines(self) -> Sequence[float]:
        return [1.0]

    def submit(self, name: str, work: Work, resources: Resources) -> None:
        self._waiting.append((name, work))

    def events(self, wait: float) -> list[Running | Ended]:
        name, work = self._waiting.pop(-1 if self._backwards else 0)
        told: list[Running | Ended] = []
        instead = self._instead
        made = work if instead is None else lambda _: instead(work.args[0])
        answer = perform(made, lambda report: told.append(Running(name, "here", report)))
        return [*told, Ended(name, answer, "here")]

    def stop(self) -> None:
        self._waiting.clear()

    def __exit__(self, *error: object) -> None:
        self._waiting.clear()


def counted(job: RegionJob) -> RegionResult:
    """Add one to the steps of a region's own Gaussians, and change nothing else. Its exposures name the task."""
    own = {name: array[job.own] for name, array in job.gaussians.items()}
    own["steps"] = own["steps"] + 1
    exposures = {index: np.full((3, 4), float(job.number)) for index in job.views}
    shares = {index: (index + job.number) % 3 / 2 for index in job.views}
    return RegionResult(RefinedRegion(own, exposures, shares, 10), 0.0, 0.0, None)


def failing(job: RegionJob) -> RegionResult:
    raise InputError("its disk is full")


@pytest.fixture
def out(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished run's folder, whose map is replaced."""
    return shutil.copytree(finished, tmp_path / "out")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.slow
def test_the_map_gets_better_and_the_folder_is_that_of_a_finished_run(out: Path) -> None:
    before, run = contents(out), open_run(out)
    metrics = refine_run(out, Plan(regions=2, rounds=1, steps=40), HereAndNow())
    earlier = json.loads(before["metrics.json"])
    assert metrics["refined"]["held_out"]["psnr"] > earlier["refined"]["held_out"]["psnr"] + 0.1

    # The map and its figures are new, and nothing else is.
    after = contents(out)
    assert after.keys() == before.keys()
    changed = {name for name in after if after[name] != before[name] and not name.startswith("renders/")}
    assert changed == {"splats.ply", "metrics.json", "scores.csv", "report.html"}
    assert json.loads(after["metrics.json"]) == metrics
    assert metrics["regions"]["before"] == earlier["refined"] and metrics["online"] == earlier["online"]
    scores = read_scores(out / "scores.csv")
    held_out = [score.psnr for score in scores if score.held_out and score.stage == "refined"]
    assert np.mean(held_out) == pytest.approx(metrics["refined"]["held_out"]["psnr"], abs=1e-3)
    assert len(scores) == 2 * len(run)
    assert len(read_splats(out / "splats.ply")["position"]) == metrics["gaussians"]


@pytest.fixture
def joined(monkeypatch: pytest.MonkeyPatch) -> list[RefinedMap]:
    """Collects the maps that would be written."""
    maps: list[RefinedMap] = []
    monkeypatch.setattr(rounds, "write_refined", lambda run, config, refined, *_: maps.append(refined))
    return maps


def test_every_gaussian_is_in_one_region_in_each_round_whatever_their_order(
    out: Path, joined: list[RefinedMap]
) -> None:
    jobs: dict[bool, list[RegionJob]] = {False: [], True: []}

    def noted(job: RegionJob, backwards: bool) -> RegionResult:
        jobs[backwards].append(job)
        return counted(job)

    plan = Plan(regions=3, rounds=2, steps=60)
    for backwards in (False, True):
        refine_run(out, plan, HereAndNow(backwards, partial(noted, backwards=backwards)))
    assert [job.number for job in jobs[False]] == [0, 1, 2, 3, 4, 5]
    assert [job.number for job in jobs[True]] == [2, 1, 0, 5, 4, 3]
    assert all((job.gaussians["steps"] == (job.number >= 3)).all() for job in jobs[False])
    first, second = joined
    for name, array in first.gaussians.items():
        np.testing.assert_array_equal(array, second.gaussians[name])
    assert first.exposures.keys() == second.exposures.keys() and first.estimated == second.estimated
    for index, exposure in first.exposures.items():
        np.testing.assert_array_equal(exposure, second.exposures[index])
    # The positions are those of the run, each once.
    was = read_splats(out / "splats.ply")["position"]
    np.testing.assert_array_equal(np.unique(first.gaussians["position"], axis=0), np.unique(was, axis=0))
    assert len(first.gaussians["position"]) == len(was)
    assert first.view_renders == 6 * 10
    # Each view has the exposure of the region that fills most of it in the last round.
    for index in first.estimated:
        numbers = [job.number for job in jobs[False][3:] if index in job.views]
        assert first.exposures[index][0, 0] == max(numbers, key=lambda number: (index + number) % 3)


def test_a_run_stays_as_it_was_if_a_region_fails(out: Path) -> None:
    before = contents(out)
    with pytest.raises(InputError, match=r"^region-1: its disk is full; the run is as it was$"):
        refine_run(out, Plan(steps=2), HereAndNow(True, failing))
    assert contents(out) == before


def test_an_interrupted_scoring_leaves_the_run_as_it_was(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(out)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(refined_run, "_score", interrupted)
    with pytest.raises(KeyboardInterrupt, match="is as it was"):
        refine_run(out, Plan(rounds=1), HereAndNow(False, counted))
    assert contents(out) == before
    assert os.listdir(out / PRIVATE) == ["files.json"]


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

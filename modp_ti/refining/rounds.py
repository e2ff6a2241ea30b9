"""`refine_run`: refines a finished map in several rounds, its regions side by side by the tasks of an engine."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from modp_ti.batch.batch import Shares
from modp_ti.batch.scenes import with_resources
from modp_ti.config.settings import WITH_SECRETS, SceneConfig
from modp_ti.engine.snapshots.file import FILE
from modp_ti.files import read_json
from modp_ti.files.errors import InputError
from modp_ti.files.sole_use import sole_use
from modp_ti.outputs.formats.exposure import read_exposures
from modp_ti.outputs.playback.finished_run import FinishedRun, open_run
from modp_ti.outputs.playback.run_pictures import kept_images, run_settings
from modp_ti.outputs.progress import ProgressLine
from modp_ti.refining.refined_run import RefinedMap, write_refined
from modp_ti.refining.region_task import RegionJob, RegionResult, refine_region_of
from modp_ti.tasks import Answer, End, Engine, Retried, Running, Task, Watched, run_tasks
from pipelines.regions.division import Eye, Region, regions
from pipelines.regions.refinement import Span, with_history

__all__ = ["GAUSSIANS_EACH", "Plan", "refine_run"]

# Number of Gaussians of a region, about, if the number of regions is not given.
GAUSSIANS_EACH = 200_000
# Steps of a refinement, if the run's settings ask for none.
STEPS = 1000


@dataclass(frozen=True)
class Plan:
    """How a map is refined.

    Attributes:
        regions: Number of regions; None for two, or one for every 200,000 Gaussians.
        rounds: Number of rounds.
        steps: Number of steps of all regions and rounds together; None for `refine.steps` of the run.
        shares: Resources of each task.
    """

    regions: int | None = None
    rounds: int = 2
    steps: int | None = None
    shares: Shares = field(default_factory=Shares)


def refine_run(folder: Path, plan: Plan, engine: Engine, console: Console | None = None) -> dict[str, Any]:
    """Refine the map of a finished run, and replace its files by those of the refined map.

    In each round, the map is divided into regions anew. Each region is refined by a task of its own, from the Gaussians
    as the last round has left them, and the results are put together. The files of the run are replaced at the end,
    together.

    Args:
        folder: Output folder of the run.
        plan: How it is refined.
        engine: Carries the tasks out.
        console: Receives progress and notes, None for no output.

    Returns:
        The content of the new `metrics.json`.

    Raises:
        InputError: If there is no finished run, its frames cannot be read again, or a task fails. The run is then as
            it was.
        KeyboardInterrupt: After Ctrl-C. The run is then as it was.
    """
    folder = folder.expanduser().resolve()
    run = open_run(folder)
    config = _settings_of(run, plan)
    with sole_use(folder):
        metrics = read_json(folder / "metrics.json", "of a finished run")
        line = ProgressLine(console or Console(quiet=True))
        try:
            refined = _Refinement(run, config, plan, engine, line).run()
            return write_refined(run, config, refined, metrics, line)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"interrupted: {folder} is as it was") from None


def _settings_of(run: FinishedRun, plan: Plan) -> SceneConfig:
    """Return the settings of the run, with those of this refinement. Raises InputError if it cannot be refined."""
    config, folder = run_settings(run), run.folder
    if (folder / FILE).is_file() or not (folder / "metrics.json").is_file():
        raise InputError(f"{folder}: its run has not finished: modp-ti run --resume {folder} goes on with it")
    if config.mode == "offline":
        raise InputError(f"{folder}: an offline map is not refined: map it with more offline.steps")
    if (config.is_live or config.source.realtime) and kept_images(run) is None:
        raise InputError(
            f"{folder}: its frames were live and cannot be read again; such a run needs `export.images: true`"
        )
    steps = plan.steps or config.refine.steps or STEPS
    refine = config.refine.model_copy(update={"steps": steps, "seconds": None})
    return config.model_copy(update={"output": folder, "refine": refine})


class _Refinement:
    """A refinement in progress: the map as the last round has left it."""

    def __init__(self, run: FinishedRun, config: SceneConfig, plan: Plan, engine: Engine, line: ProgressLine) -> None:
        self._run, self._config, self._plan, self._engine, self._line = run, config, plan, engine, line
        self._mapped = run.mapped
        self._eyes = [Eye(run.cameras[place], run.poses[place]) for place in self._mapped]
        self._gaussians = with_history(run.gaussians)
        self._exposures = read_exposures(run.folder / "exposure.json")
        self._estimated: set[int] = set()
        self._rounds: list[dict[str, Any]] = []
        self._view_renders = 0

    def run(self) -> RefinedMap:
        count = self._plan.regions
        if count is None:
            count = max(2, -(-len(self._gaussians["position"]) // GAUSSIANS_EACH))
        began = time.perf_counter()
        self._line.note(f"refining in {count} regions, {self._plan.rounds} rounds")
        # Every task of a round prepares for some 20 s, in which no step is made: only the mean pace says what is left.
        self._line.start("refining", self._config.refine.steps, recent=1.0)
        try:
            for number in range(self._plan.rounds):
                self._round(number, count)
        finally:
            self._line.stop()
        names = self._run.gaussians
        return RefinedMap(
            {name: self._gaussians[name] for name in names},
            self._exposures,
            self._estimated,
            self._view_renders,
            {"rounds": self._rounds, "seconds": round(time.perf_counter() - began, 3)},
        )

    def _round(self, number: int, count: int) -> None:
        """Refine all regions once, and put them together."""
        parts = regions(self._gaussians, self._eyes, self._run.record.scene_depth, count, number)
        spans = _spans([part.load for part in parts], self._config.refine.steps, number, self._plan.rounds)
        chosen = [place for place, span in enumerate(spans) if span.end > span.first]
        machines = self._engine.machines
        resources = self._plan.shares.of(self._config, machines, max(len(chosen), 1))
        settings = with_resources(self._config, resources).model_dump(mode="json", context=WITH_SECRETS)
        tasks = []
        for place in chosen:
            job = self._job(parts[place], spans[place], settings, number * count + place)
            name = f"region-{place + 1}"
            tasks.append(Task(name, partial(refine_region_of, job), resources, self._plan.shares.attempts))
        watch = _Watch(self._line, sum(span.first for span in spans))
        answers = run_tasks(self._engine, tasks, watch)
        for answer in answers.values():
            if answer.traceback:
                self._line.note(answer.traceback)
        results = [_result(task.name, answers[task.name]) for task in tasks]
        self._join(parts, dict(zip(chosen, results, strict=True)))

    def _job(self, part: Region, span: Span, settings: dict[str, Any], number: int) -> RegionJob:
        places = np.concatenate([part.own, part.around])
        return RegionJob(
            settings=settings,
            folder=self._run.folder,
            number=number,
            gaussians={name: array[places] for name, array in self._gaussians.items()},
            own=np.arange(len(places)) < len(part.own),
            exposures=self._exposures,
            views=[self._mapped[view] for view in part.views.tolist()],
            span=span,
        )

    def _join(self, parts: Sequence[Region], results: Mapping[int, RegionResult]) -> None:
        """Put the regions together. A view takes its exposure from the region that fills most of it."""
        most: dict[int, float] = {}
        joined = []
        for place, part in enumerate(parts):
            if place not in results:
                joined.append({name: array[part.own] for name, array in self._gaussians.items()})
                continue
            region = results[place].region
            joined.append(region.gaussians)
            self._view_renders += region.view_renders
            for index, exposure in region.exposures.items():
                if region.shares[index] > most.get(index, -1.0):
                    most[index] = region.shares[index]
                    self._exposures[index] = exposure
        self._estimated.update(most)
        self._gaussians = {name: np.concatenate([part[name] for part in joined]) for name in self._gaussians}
        self._rounds.append({"regions": [_figures(part, results.get(place)) for place, part in enumerate(parts)]})


class _Watch:
    """Shows how many steps all regions of a round have made. Called with the events of `run_tasks`."""

    def __init__(self, line: ProgressLine, done: int) -> None:
        self._line, self._done = line, done
        self._steps: dict[str, tuple[int, float]] = {}
        self._first: dict[str, int] = {}

    def __call__(self, event: Watched | None) -> None:
        if isinstance(event, Retried):
            self._line.note(f"{event.name}: {event.error}; attempt {event.attempt} begins")
        elif isinstance(event, Running) and event.report is not None:
            step, psnr = event.report
            first = self._first.setdefault(event.name, step - 1)
            self._steps[event.name] = step - first, psnr
            done = self._done + sum(steps for steps, _ in self._steps.values())
            self._line.step(done, float(np.mean([psnr for _, psnr in self._steps.values()])))


def _spans(loads: Sequence[float], steps: int, number: int, rounds: int) -> list[Span]:
    """Divide the steps of a refinement among regions in proportion to their loads, and return those of one round.

    A region's steps are the same in each round, up to one. Together, the regions make `steps` steps, up to rounding.
    """
    whole = max(sum(loads), 1e-9)
    totals = [round(steps * load / whole) for load in loads]
    return [Span(total * number // rounds, total * (number + 1) // rounds, total) for total in totals]


def _result(name: str, answer: Answer) -> RegionResult:
    if answer.end is End.done:
        return answer.value
    raise InputError(f"{name}: {answer.error}; the run is as it was")


def _figures(part: Region, result: RegionResult | None) -> dict[str, Any]:
    """Return what `metrics.json` says of a region in a round."""
    figures: dict[str, Any] = {"gaussians": len(part.own), "around": len(part.around), "views": len(part.views)}
    if result is None:
        return figures
    return figures | {
        "view_renders": result.region.view_renders,
        "seconds": round(result.seconds, 3),
        "cpu_seconds": round(result.cpu_seconds, 3),
        "memory_mb": result.memory_mb,
    }

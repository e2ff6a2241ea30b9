"""`run_batch`: maps the scenes of a batch by the tasks of an engine, and writes their tables and the summary page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from rich.console import Console

from modp_ti.batch.finished import finished_metrics
from modp_ti.batch.progress_table import ProgressTable
from modp_ti.batch.results import SceneResult, State, figures, write_csv, write_parquet
from modp_ti.batch.scene_task import fetch_finished, map_scene
from modp_ti.batch.scenes import Scene, with_resources
from modp_ti.batch.summary_page import write_summary_page
from modp_ti.config.settings import WITH_SECRETS, SceneConfig
from modp_ti.files.atomic import replace_text
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import appearing
from modp_ti.files.urls import shown_url
from modp_ti.outputs.progress import StageProgress
from modp_ti.tasks import Answer, End, Ended, Engine, Resources, Retried, Running, Stopping, Task, Watched, run_tasks

__all__ = ["Shares", "run_batch"]

CSV, PARQUET, PAGE, LOGS = "batch.csv", "batch.parquet", "index.html", "logs"


@dataclass(frozen=True)
class Shares:
    """What each scene gets.

    Attributes:
        cpus: Cores; None for an equal share of all, but at least one, and no more than a machine has.
        gpus: GPUs; None for one where the scene's `device` is a GPU, otherwise none.
        memory: Memory [bytes], None if it is not known.
        attempts: How often a scene is begun if its process or its machine is lost.
    """

    cpus: float | None = None
    gpus: float | None = None
    memory: int | None = None
    attempts: int = 3

    def of(self, config: SceneConfig, machines: Sequence[float], scenes: int) -> Resources:
        """Return the resources of a scene, one of so many, on machines with these numbers of cores."""
        cpus = self.cpus
        if cpus is None:
            cpus = float(max(1, int(min(min(machines, default=1), sum(machines) / scenes))))
        gpus = self.gpus
        if gpus is None:
            gpus = 0.0 if config.device in ("cpu", "auto") else 1.0
        return Resources(cpus, gpus, self.memory)


def run_batch(
    scenes: Sequence[Scene], engine: Engine, folder: Path, shares: Shares | None = None, console: Console | None = None
) -> list[SceneResult]:
    """Map the scenes that are not finished, and write `batch.csv`, `batch.parquet` and `index.html` on the way.

    Args:
        scenes: The scenes.
        engine: Carries the tasks out.
        folder: Folder for the tables, the summary page and the tracebacks of faults.
        shares: What each scene gets, None for the defaults.
        console: Shows progress and notes, None for no output.

    Returns:
        The results, in the order of the scenes.

    Raises:
        InputError: If the folder cannot be written.
        KeyboardInterrupt: After Ctrl-C, when the scenes that ran have saved what they had.
    """
    return _Batch(scenes, engine, folder, shares or Shares(), console or Console(quiet=True)).run()


class _Batch:
    """A batch in progress: the results so far by the name of the scene."""

    def __init__(self, scenes: Sequence[Scene], engine: Engine, folder: Path, shares: Shares, console: Console) -> None:
        self._engine = engine
        self._folder = folder
        self._shares = shares
        self._configs = {scene.name: scene.config for scene in scenes if scene.config is not None}
        self._results = {scene.name: _before(scene) for scene in scenes}
        self._table = ProgressTable(console, lambda: list(self._results.values()))
        self._unwritten = ""

    def run(self) -> list[SceneResult]:
        self._write()
        if self._unwritten:
            raise InputError(self._unwritten)
        with self._table:
            for result in self._results.values():
                if result.state is not State.waiting:
                    self._table.ended(result)
            try:
                run_tasks(self._engine, self._tasks(), self._watch)
            except KeyboardInterrupt:
                self._write()
                done = sum(result.state in (State.finished, State.before) for result in self._results.values())
                raise KeyboardInterrupt(
                    f"interrupted: {done} of {len(self._results)} scenes are finished; the same command goes on"
                ) from None
            finally:
                self._write()
        return list(self._results.values())

    def _tasks(self) -> list[Task]:
        """Return the tasks of the scenes that wait. One whose finished files are in its storage is fetched instead."""
        wanted = {}
        for name, config in self._configs.items():
            if self._results[name].state is State.waiting and not self._fetched(name, config):
                wanted[name] = config
        machines, tasks = self._engine.machines, []
        for name, config in wanted.items():
            resources = self._shares.of(config, machines, len(wanted))
            settings = with_resources(config, resources).model_dump(mode="json", context=WITH_SECRETS)
            tasks.append(Task(name, partial(map_scene, settings), resources, self._shares.attempts))
        return tasks

    def _fetched(self, name: str, config: SceneConfig) -> bool:
        try:
            if not fetch_finished(config):
                return False
        except InputError as error:
            self._table.note(f"{name}: {error}")
            return False
        self._end(name, State.before)
        return True

    def _watch(self, event: Watched | None) -> None:
        if isinstance(event, Running):
            attempts = self._results[event.name].attempts or 1
            self._change(event.name, machine=event.machine, attempts=attempts)
            progress = event.report if isinstance(event.report, StageProgress) else None
            self._table.running(event.name, event.machine, progress)
        elif isinstance(event, Retried):
            self._change(event.name, attempts=event.attempt)
            self._table.retried(event.name, event.attempt, event.error)
        elif isinstance(event, Ended):
            if event.answer.end is not End.interrupted:
                known = self._results[event.name]
                self._change(event.name, attempts=known.attempts or 1, machine=event.machine or known.machine)
            self._answered(event.name, event.answer)
        elif isinstance(event, Stopping):
            self._table.note("stopping when all scenes have saved what they have; Ctrl-C again stops at once")
        self._table.tick()

    def _answered(self, name: str, answer: Answer) -> None:
        """Note the end of a scene. Where its files are here, it is finished, whatever the answer says."""
        if answer.traceback:
            self._keep_traceback(name, answer.traceback)
        try:
            here = fetch_finished(self._configs[name])
            error = answer.error or "its files are not here, and there is no --store to fetch them from"
        except InputError as problem:
            here, error = False, str(problem)
        if here:
            if answer.traceback:
                self._table.note(
                    f"{name}: {answer.error}, after its files were complete: see {LOGS}/{name}.traceback.txt"
                )
            self._end(name, State.finished)
        elif answer.end is End.interrupted:
            self._end(name, State.waiting)
        else:
            self._end(name, State.failed, error)

    def _keep_traceback(self, name: str, text: str) -> None:
        try:
            with appearing(self._folder) as staged:
                (staged / LOGS).mkdir()
                replace_text(staged / LOGS / f"{name}.traceback.txt", text)
        except InputError as error:
            self._table.note(f"{name}: its traceback cannot be written: {error}")

    def _end(self, name: str, state: State, error: str = "") -> None:
        metrics = finished_metrics(self._configs[name]) if state in (State.finished, State.before) else None
        self._change(name, state=state, error=error, **({} if metrics is None else figures(metrics)))
        self._table.ended(self._results[name])
        self._write()

    def _change(self, name: str, **changes: object) -> None:
        self._results[name] = replace(self._results[name], **changes)

    def _write(self) -> None:
        """Write tables and page. Once the batch runs, a disk that is full only delays them."""
        results, before = list(self._results.values()), self._unwritten
        try:
            with appearing(self._folder) as staged:
                write_csv(staged / CSV, results)
                write_parquet(staged / PARQUET, results)
                write_summary_page(staged / PAGE, results, self._folder)
            self._unwritten = ""
        except InputError as error:
            self._unwritten = str(error)
            if self._unwritten != before:
                self._table.note(self._unwritten)


def _before(scene: Scene) -> SceneResult:
    """Return the result of a scene before the batch begins."""
    given = shown_url(str(scene.given))
    if scene.config is None:
        return SceneResult(scene.name, given, None, State.failed, error=scene.error)
    result = SceneResult(scene.name, given, str(scene.config.output), State.waiting)
    metrics = finished_metrics(scene.config)
    return result if metrics is None else replace(result, state=State.before, **figures(metrics))

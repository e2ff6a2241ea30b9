"""`run_batch`: maps the scenes of a batch by the tasks of a pool, and writes their tables and the summary page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic

from rich.console import Console

from modp_ti.config.settings import WITH_SECRETS, SceneConfig
from modp_ti.engine.interruption import Interruption
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import appearing
from modp_ti.files.urls import shown_url
from modp_ti.many.pool import Ended, Pool, Resources, Running
from modp_ti.many.results import (
    ProgressTable,
    SceneResult,
    State,
    figures,
    write_csv,
    write_parquet,
    write_summary_page,
)
from modp_ti.many.scenes import Scene, fetch_finished, finished_metrics
from modp_ti.many.task import PATIENCE, End

CSV, PARQUET, PAGE, LOGS = "batch.csv", "batch.parquet", "index.html", "logs"
# Longest wait for an event [s]: how often the table is brought up to date at least.
GLANCE = 0.5


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


def with_resources(config: SceneConfig, resources: Resources) -> SceneConfig:
    """Return a scene's settings for a process that has these resources: as many threads as cores, no GPU without one.

    A number of threads that the scene sets is kept.
    """
    threads = config.threads or max(1, int(resources.cpus))
    return config.model_copy(update={"threads": threads, "device": config.device if resources.gpus else "cpu"})


def run_batch(
    scenes: Sequence[Scene], pool: Pool, folder: Path, shares: Shares | None = None, console: Console | None = None
) -> list[SceneResult]:
    """Map the scenes that are not finished, and write `batch.csv`, `batch.parquet` and `index.html` on the way.

    Args:
        scenes: The scenes.
        pool: Carries the tasks out.
        folder: Folder for the tables and the summary page.
        shares: What each scene gets, None for the defaults.
        console: Shows progress and notes, None for no output.

    Returns:
        The results, in the order of the scenes.

    Raises:
        InputError: If the folder cannot be written.
        KeyboardInterrupt: After Ctrl-C, when the scenes that ran have saved what they had. A second Ctrl-C raises it at
            once.
    """
    return _Batch(scenes, pool, folder, shares or Shares(), console or Console(quiet=True)).run()


class _Batch:
    """A batch in progress: the results so far by the name of the scene."""

    def __init__(self, scenes: Sequence[Scene], pool: Pool, folder: Path, shares: Shares, console: Console) -> None:
        self._pool = pool
        self._folder = folder
        self._shares = shares
        self._configs = {scene.name: scene.config for scene in scenes if scene.config is not None}
        self._results = {scene.name: _before(scene) for scene in scenes}
        self._submitted: dict[str, Resources] = {}  # of the scenes that have not ended
        self._table = ProgressTable(console, lambda: list(self._results.values()))
        self._unwritten = ""

    def run(self) -> list[SceneResult]:
        self._write()
        if self._unwritten:
            raise InputError(self._unwritten)
        with self._table, Interruption(lambda: None) as stop:
            stop.begin()
            for result in self._results.values():
                if result.state is not State.waiting:
                    self._table.ended(result)
            try:
                self._submit_all()
                while self._submitted and not stop.asked:
                    self._look(retry=True)
                if self._submitted:
                    self._stop()
            finally:
                self._write()
        return list(self._results.values())

    def _submit_all(self) -> None:
        """Submit the scenes that wait. One whose finished files are in its storage is fetched instead."""
        wanted = {}
        for name, config in self._configs.items():
            if self._results[name].state is State.waiting and not self._fetched(name, config):
                wanted[name] = config
        machines = self._pool.machines
        for name, config in wanted.items():
            self._submitted[name] = self._shares.of(config, machines, len(wanted))
            self._submit(name)

    def _submit(self, name: str) -> None:
        resources = self._submitted[name]
        settings = with_resources(self._configs[name], resources).model_dump(mode="json", context=WITH_SECRETS)
        self._pool.submit(name, settings, resources)

    def _fetched(self, name: str, config: SceneConfig) -> bool:
        try:
            if not fetch_finished(config):
                return False
        except InputError as error:
            self._table.note(f"{name}: {error}")
            return False
        self._end(name, State.before)
        return True

    def _stop(self) -> None:
        """Have the scenes that run save what they have, and raise KeyboardInterrupt."""
        self._table.note("stopping when all scenes have saved what they have; Ctrl-C again stops at once")
        self._pool.stop()
        until = monotonic() + PATIENCE
        while self._submitted and monotonic() < until:
            self._look(retry=False)
        done = sum(result.state.is_done for result in self._results.values())
        raise KeyboardInterrupt(
            f"interrupted: {done} of {len(self._results)} scenes are finished; the same command resumes the others"
        )

    def _look(self, retry: bool) -> None:
        """Wait for events for a moment, and note them. With `retry`, lost tasks are submitted again."""
        for event in self._pool.events(GLANCE):
            name, known = event.name, self._results[event.name]
            if isinstance(event, Running):
                self._change(name, machine=event.machine, attempts=known.attempts or 1)
                self._table.running(name, event.machine, event.progress)
                continue
            if event.end is not End.interrupted or event.machine:
                self._change(name, attempts=known.attempts or 1, machine=event.machine or known.machine)
            attempts = self._results[name].attempts
            lost = event.end in (End.lost, End.interrupted)  # nobody has asked it to end
            if retry and lost and attempts < self._shares.attempts:
                self._change(name, attempts=attempts + 1)
                self._table.retried(name, attempts + 1, event.error)
                self._submit(name)
                continue
            del self._submitted[name]
            self._ended(event, stopped=not retry)
        self._table.tick()

    def _ended(self, event: Ended, stopped: bool) -> None:
        """Note the end of a scene. Where its files are here, it is finished, whatever the event says."""
        try:
            here = fetch_finished(self._configs[event.name])
            error = event.error or "its files are not here, and there is no --store to fetch them from"
        except InputError as problem:
            here, error = False, str(problem)
        if here:
            if event.end is End.fault:
                self._table.note(f"{event.name}: after its files were complete: {event.error}")
            self._end(event.name, State.finished)
        elif stopped and event.end is End.interrupted:
            self._end(event.name, State.waiting)
        else:
            self._end(event.name, State.failed, error)

    def _end(self, name: str, state: State, error: str = "") -> None:
        metrics = finished_metrics(self._configs[name]) if state.is_done else None
        self._change(name, state=state, error=error, figures={} if metrics is None else figures(metrics))
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
    return result if metrics is None else replace(result, state=State.before, figures=figures(metrics))

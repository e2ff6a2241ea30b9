"""`run_batch`: maps scenes by the tasks of a pool, and writes their tables and the summary page."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic

from rich.console import Console

from modp_ti.config.bare_recording import base_of, named_scene
from modp_ti.config.scene_paths import refuse_output_in_input
from modp_ti.config.settings import SceneConfig, ViewSettings
from modp_ti.engine.interruption import Interruption
from modp_ti.files.errors import InputError, actual_url, shown_url
from modp_ti.files.run_folder import appearing
from modp_ti.inputs.source_settings import WITH_SECRETS
from modp_ti.many.pool import Ended, Pool, Resources, Running
from modp_ti.many.results import (
    BatchProgress,
    SceneResult,
    State,
    figures,
    write_csv,
    write_parquet,
    write_summary_page,
)
from modp_ti.many.task import PATIENCE, End, fetch_finished
from modp_ti.outputs.playback.finished_run import finished_metrics

CSV, PARQUET, PAGE, LOGS = "batch.csv", "batch.parquet", "index.html", "logs"
# Longest wait for an event [s]: how often the table is brought up to date at least.
GLANCE = 0.5


# Frames between snapshots where the scene does not set `snapshot_every`.
SNAPSHOT_EVERY = 50


@dataclass(frozen=True)
class Scene:
    """A recording of a batch.

    Attributes:
        name: Unique name in the batch: that of its output folder or, if it cannot be read, of what the user named.
        given: What the user named.
        config: Its settings, None if they cannot be read.
        error: Otherwise one line that says why.
    """

    name: str
    given: Path
    config: SceneConfig | None = None
    error: str = ""


def read_scenes(given: Iterable[Path], overrides: Sequence[str] = (), preset: str | None = None) -> list[Scene]:
    """Read the settings of scene files and recordings. One that cannot be read does not hinder the others.

    Args:
        given: Scene files, videos and folders of images. One that is named twice counts once.
        overrides: As for `load_scene`, for every scene.
        preset: As for `load_scene`, for every scene.

    Returns:
        The scenes, in order. No two write to the same folder.
    """
    scenes: list[Scene] = []
    outputs: dict[Path, Path] = {}  # what the user named, by the output folder
    for path in {path.expanduser().resolve(): path for path in given}.values():
        try:
            config = _read(path, overrides, preset, list(outputs))
            if config.output in outputs:
                other = outputs[config.output]
                raise InputError(f"{path}: {config.output} is the output folder of {other} too: set another one")
        except InputError as error:
            scenes.append(Scene(_unique(Path(shown_url(str(path))).name or str(path), scenes), path, error=str(error)))
            continue
        outputs[config.output] = path
        scenes.append(Scene(_unique(config.output.name, scenes), path, config))
    return scenes


def _read(path: Path, overrides: Sequence[str], preset: str | None, taken: list[Path]) -> SceneConfig:
    config = named_scene(path, overrides, preset, taken)
    refuse_output_in_input(config, base_of(path))
    if config.is_live:
        raise InputError(f"{path}: a live source has no place in a batch: map it with `modp-ti run`")
    if config.parts is not None:
        raise InputError(f"{path}: parts are mapped by tasks of their own: map it with `modp-ti run`, or remove parts")
    return for_a_task(config)


def for_a_task(config: SceneConfig) -> SceneConfig:
    """Return a scene's settings for a run in a process that may be lost, and that nobody watches."""
    every = config.snapshot_every
    if every is None and config.can_be_resumed:
        every = SNAPSHOT_EVERY
    return config.model_copy(update={"snapshot_every": every, "view": ViewSettings()})


def _unique(name: str, others: Sequence[Scene]) -> str:
    taken = {scene.name for scene in others}
    choices = (name if number == 1 else f"{name}-{number}" for number in range(1, len(taken) + 2))
    return next(choice for choice in choices if choice not in taken)


def with_store(scenes: Iterable[Scene], url: str) -> list[Scene]:
    """Return scenes whose snapshots are copied to folders of their own below a URL.

    The folder's name ends with a checksum of the output folder, so that it does not depend on the other scenes.
    """
    url, stored = actual_url(url), []
    for scene in scenes:
        if scene.config is not None:
            output = scene.config.output
            own = f"{url.rstrip('/')}/{output.name}-{zlib.crc32(str(output).encode()):08x}"
            scene = replace(scene, config=scene.config.model_copy(update={"snapshot_store": own}))
        stored.append(scene)
    return stored


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
        self._line = BatchProgress(console, len(self._results))

    def run(self) -> list[SceneResult]:
        self._write()
        with self._line, Interruption(lambda: None) as stop:
            stop.begin()
            for result in self._results.values():
                if result.state is not State.waiting:
                    self._line.ended(result)
            try:
                self._submit_all()
                while self._submitted and not stop.asked:
                    self._look(retry=True)
                if self._submitted:
                    self._stop()
            finally:
                self._write_later()
        return list(self._results.values())

    def _submit_all(self) -> None:
        wanted = [name for name, result in self._results.items() if result.state is State.waiting]
        machines = self._pool.machines
        for name in wanted:
            self._submitted[name] = self._shares.of(self._configs[name], machines, len(wanted))
            self._submit(name)

    def _submit(self, name: str) -> None:
        resources = self._submitted[name]
        settings = with_resources(self._configs[name], resources).model_dump(mode="json", context=WITH_SECRETS)
        self._pool.submit(name, settings, resources)

    def _stop(self) -> None:
        """Have the scenes that run save what they have, and raise KeyboardInterrupt."""
        self._line.note("stopping when all scenes have saved what they have; Ctrl-C again stops at once")
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
                self._line.running(name, event.machine, event.progress)
                continue
            if event.end is not End.interrupted or event.machine:
                self._change(name, attempts=known.attempts or 1, machine=event.machine or known.machine)
            attempts = self._results[name].attempts
            lost = event.end in (End.lost, End.interrupted)  # nobody has asked it to end
            if retry and lost and attempts < self._shares.attempts:
                self._change(name, attempts=attempts + 1)
                self._line.retried(name, attempts + 1, event.error)
                self._submit(name)
                continue
            del self._submitted[name]
            self._ended(event, stopped=not retry)
        self._line.tick()

    def _ended(self, event: Ended, stopped: bool) -> None:
        """Note the end of a scene. Where its files are here, it is finished, whatever the event says."""
        try:
            here = fetch_finished(self._configs[event.name])
            error = event.error or "its files are not here, and there is no --store to fetch them from"
        except InputError as problem:
            here, error = False, str(problem)
        if here:
            if event.end is End.fault:
                self._line.note(f"{event.name}: after its files were complete: {event.error}")
            self._end(event.name, State.finished)
        elif stopped and event.end is End.interrupted:
            self._end(event.name, State.waiting)
        else:
            self._end(event.name, State.failed, error)

    def _end(self, name: str, state: State, error: str = "") -> None:
        metrics = finished_metrics(self._configs[name]) if state.is_done else None
        self._change(name, state=state, error=error, figures={} if metrics is None else figures(metrics))
        self._line.ended(self._results[name])
        self._write_later()

    def _change(self, name: str, **changes: object) -> None:
        self._results[name] = replace(self._results[name], **changes)

    def _write(self) -> None:
        """Write tables and page."""
        results = list(self._results.values())
        with appearing(self._folder) as staged:
            write_csv(staged / CSV, results)
            write_parquet(staged / PARQUET, results)
            write_summary_page(staged / PAGE, results, self._folder)

    def _write_later(self) -> None:
        """Write tables and page. A disk that is full only delays them."""
        try:
            self._write()
        except InputError as error:
            self._line.note(str(error))


def _before(scene: Scene) -> SceneResult:
    """Return the result of a scene before the batch begins."""
    given = shown_url(str(scene.given))
    if scene.config is None:
        return SceneResult(scene.name, given, None, State.failed, error=scene.error)
    result = SceneResult(scene.name, given, str(scene.config.output), State.waiting)
    try:
        fetch_finished(scene.config)  # from its storage
    except InputError:
        pass  # it is mapped again
    metrics = finished_metrics(scene.config)
    return result if metrics is None else replace(result, state=State.before, figures=figures(metrics))

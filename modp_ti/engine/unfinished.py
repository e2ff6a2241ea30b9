"""`Unfinished`: saves the map so far of a run that stops before its end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from modp_ti.config.settings import SceneConfig
from modp_ti.engine.interruption import RunStopped
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.results import Results
from modp_ti.engine.snapshots import Checkpointer
from modp_ti.files.errors import InputError
from modp_ti.inputs.protocol import Tracker
from modp_ti.outputs.evaluation import MapVersion
from pipelines.companions.block_files import BlockError


class Unfinished:
    """Saves the map so far, and returns the exception that tells where it is and how to go on.

    Args:
        config: The scene's settings.
        mapper: The mapper.
        tracker: The tracker.
        checkpointer: Writes the run's snapshots.
    """

    def __init__(self, config: SceneConfig, mapper: Mapper, tracker: Tracker, checkpointer: Checkpointer) -> None:
        self._config = config
        self._mapper = mapper
        self._tracker = tracker
        self._checkpointer = checkpointer

    def interrupted(self) -> KeyboardInterrupt:
        """Save a snapshot and the map after Ctrl-C."""
        resumable = self._checkpointer.keep() or self._checkpointer.usable
        said = f"interrupted after {len(self._mapper.frames)} frames{self._save()}"
        return KeyboardInterrupt(f"{said}; modp-ti run --resume {self._config.output} goes on" if resumable else said)

    def damaged(self, error: BlockError) -> InputError:
        """Save the map without a block whose file was damaged. The last snapshot stays as it was."""
        return InputError(f"{error}{self._save()}{self._checkpointer.way_on()}")

    @contextmanager
    def naming_snapshot(self) -> Iterator[None]:
        """Add to errors inside this context how to go on from the snapshot, if there is one."""
        try:
            yield
        except (RunStopped, BlockError):
            raise
        except Exception as error:
            if way_on := self._checkpointer.way_on():
                error.args = (f"{error}{way_on}",)
            raise

    def way_on(self, version: MapVersion) -> str:
        """Return the part of an error message that says how to go on, or where the map is."""
        if self._checkpointer.usable:
            return self._checkpointer.way_on()
        pipeline = self._mapper.pipeline
        return self._results().elsewhere(version, pipeline.keyframes, pipeline.near)

    def _save(self) -> str:
        """Save the map, and return the part of a message that says where it is, or "" if there is none yet."""
        keyframes = self._mapper.pipeline.keyframes
        if not len(keyframes):
            return ""
        results, version = self._results(), self._version()
        try:
            with results.writing_map():
                results.write_map(version, keyframes, self._mapper.pipeline.near)
        except InputError as error:
            raise InputError(f"{error}{self.way_on(version)}") from None
        return f"; the map so far is in {self._config.output}"

    def _version(self) -> MapVersion:
        """The map as far as its blocks can be read."""
        while True:
            try:
                return self._mapper.version()
            except BlockError:
                continue  # without the damaged block, of which there are finitely many

    def _results(self) -> Results:
        return Results(self._config, self._mapper.frames, self._tracker.undistorter)

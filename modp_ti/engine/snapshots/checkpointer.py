"""`Checkpointer`: writes the snapshots of a run, and copies them to `snapshot_store`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from modp_ti.config.settings import SceneConfig
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.run_clock import RunClock
from modp_ti.engine.snapshots.snapshot import (
    FILE,
    Position,
    Snapshot,
    StreamDigest,
    frames_state,
    record_state,
    version_state,
)
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import appearing
from modp_ti.files.storage import Storage, StorageError
from modp_ti.outputs.evaluation import MapVersion
from modp_ti.outputs.report.record import RunRecord

# Failures in a row after which nothing more is copied, since each may take minutes.
TOO_MANY = 2


class Checkpointer:
    """Writes `snapshot.npz` to the output folder, at the configured interval and on request.

    Args:
        config: The scene's settings.
        mapper: The mapper whose state is saved.
        record: Notes for the report, saved with it.
        clock: The run's clock.
        say: Called with one line the first time that a snapshot cannot be written.

    Attributes:
        possible: Whether this run can be resumed at all.
        digest: Digest of what the tracker has delivered so far.
        online: The map before refinement, None until refinement begins.
        refined: Number of finished refinement steps.
        resumed: How often the run was resumed.
        written: Number of snapshots that were written.
        failed: Number of snapshots that could not be written.
    """

    def __init__(
        self, config: SceneConfig, mapper: Mapper, record: RunRecord, clock: RunClock, say: Callable[[str], None]
    ) -> None:
        self.config = config
        self.path: Path = config.output / FILE
        self._store = SnapshotStore(config.snapshot_store, say) if config.snapshot_store else None
        self.possible = config.can_be_resumed
        self.digest = StreamDigest()
        self.online: MapVersion | None = None
        self.refined = self.resumed = self.written = self.failed = 0
        self._mapper = mapper
        self._record = record
        self._clock = clock
        self._say = say
        self._every = (config.snapshot_every or 0) if self.possible else 0
        self._last: Position | None = None

    def after_frame(self) -> None:
        """Write a snapshot if `snapshot_every` frames have been mapped since the last one that was due."""
        if self._every and len(self._mapper.frames) % self._every == 0:
            self.keep()

    def after_mapping(self) -> None:
        """Write a snapshot before refinement begins, if snapshots are enabled."""
        if self._every:
            self.keep()

    def after_step(self, step: int, steps: int | None) -> None:
        """Record the finished refinement step `step`, which counts from 1, and write a snapshot if one is due.

        A snapshot is due after as many steps as `snapshot_every` keyframes take, and after the last step.
        """
        self.refined = step
        if self._every and (step == steps or step % (self._every * self.config.mapping.optimise.steps) == 0):
            self.keep()

    def keep(self) -> bool:
        """Write a snapshot of the current state, or keep the previous one; return whether there is a current one."""
        if not self.possible:
            return False
        position = Position(self.digest.events, self.digest.value, self._mapper.finished, self.refined)
        if position == self._last:
            return True
        try:
            with appearing(self.path.parent) as folder:
                self._snapshot(position).write(folder / FILE)
        except InputError as error:
            self.failed += 1
            if self.failed == 1:
                left = "the previous one is kept" if self.usable else "there is none yet"
                self._say(f"a snapshot cannot be written: {error}; {left}, and the run continues")
            return False
        self.written += 1
        self._last = position
        if self._store is not None:
            self._store.put(self.path)
        return True

    @property
    def usable(self) -> bool:
        """Whether there is a snapshot of this run in the output folder."""
        return self.possible and self.written > 0 and self.path.is_file()

    def way_on(self) -> str:
        """Return the part of an error message that says how to resume, or "" if the run cannot be resumed."""
        if not self.usable:
            return ""
        return f"; fix the cause, then continue from the snapshot with `modp-ti run --resume {self.path.parent}`"

    def remove(self) -> None:
        """Delete the snapshot of a finished run and its copy."""
        try:
            with appearing(self.path.parent, (FILE,)):
                pass
        except InputError as error:
            self._say(f"{error}; the snapshot of this finished run is left there")
        if self._store is not None:
            self._store.remove()

    def go_on_from(self, snapshot: Snapshot) -> None:
        """Restore what a snapshot holds besides the map. Raises InputError if the snapshot is incomplete."""
        with snapshot.fitting():
            self.online = snapshot.online()
            self.refined = snapshot.position.refined
            self.resumed = int(snapshot.number("resumed")) + 1
            self.written = int(snapshot.number("written"))
            self._clock.resume(snapshot.number("total"), snapshot.number("mapping"))
            snapshot.record(self._record)

    def _snapshot(self, position: Position) -> Snapshot:
        version, frames = version_state(self.online), frames_state(self._mapper.frames)
        of_map, record = self._mapper.state(), record_state(self._record)
        numbers = {
            "map": of_map.numbers,
            "frames": frames.numbers,
            "online": version.numbers,
            "watch": self._mapper.pipeline.stopwatch.seconds,
            "started": self._record.started,
            "total": self._clock.total,
            "mapping": self._clock.mapping,
            "resumed": self.resumed,
            "written": self.written + 1,
        }
        arrays = of_map.arrays | frames.arrays | version.arrays | record.arrays
        return Snapshot(self.path, self.config.model_dump(mode="json"), position, arrays, numbers)


class SnapshotStore:
    """Copies each snapshot of a run to a storage. A storage that fails does not stop the run.

    Args:
        url: URL of the folder for the run's snapshot.
        say: Called with one line when copying fails for the first time.

    Raises:
        StorageError: If there is no such kind of storage.
    """

    def __init__(self, url: str, say: Callable[[str], None]) -> None:
        self._storage = Storage(url)
        self._say = say
        self._failures = 0
        self._said = False

    def put(self, file: Path) -> None:
        """Copy a snapshot file."""
        if self._failures == TOO_MANY:
            return
        try:
            self._storage.put(file, FILE)
            self._failures = 0
        except StorageError as error:
            self._failed(f"{error}; snapshots stay on this machine, and the run continues")

    def remove(self) -> None:
        """Remove the copy of a finished run."""
        try:
            self._storage.remove(FILE)
        except StorageError as error:
            self._failed(f"{error}; a snapshot of this finished run may be left there")

    def _failed(self, what: str) -> None:
        self._failures += 1
        if not self._said:
            self._said = True
            self._say(what)

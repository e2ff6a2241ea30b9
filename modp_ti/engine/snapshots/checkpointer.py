"""`Checkpointer`: takes the snapshots of a run while it goes on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from modp_ti.config.settings import SceneConfig
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.run_clock import RunClock
from modp_ti.engine.snapshots.digest import StreamDigest
from modp_ti.engine.snapshots.file import FILE
from modp_ti.engine.snapshots.snapshot import Position, Snapshot, frames_state, record_state, version_state
from modp_ti.outputs.evaluation import MapVersion
from modp_ti.outputs.report.record import RunRecord

__all__ = ["Checkpointer"]


class Checkpointer:
    """Writes `snapshot.npz` into the output folder: when it is due, and when it is asked to.

    possible: whether the run can be resumed at all. digest: of what the tracker has delivered. online: the map before
    refinement, once there is one. refined: steps of refinement that are done. resumed: how often the run was. written,
    failed: how many snapshots. say: called with one line where one cannot be written.
    """

    def __init__(
        self, config: SceneConfig, mapper: Mapper, record: RunRecord, clock: RunClock, say: Callable[[str], None]
    ) -> None:
        self.config = config
        self.path: Path = config.output / FILE
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
        """A frame has been mapped: keep it all where so many have been since the last time."""
        if self._every and len(self._mapper.frames) % self._every == 0:
            self.keep()

    def after_mapping(self) -> None:
        """All frames are mapped: refinement begins."""
        if self._every:
            self.keep()

    def after_step(self, step: int, steps: int) -> None:
        """A step of refinement is done. As many as so many keyframes take make a snapshot due, and so does the last."""
        self.refined = step
        if self._every and (step == steps or step % (self._every * self.config.mapping.optimise.steps) == 0):
            self.keep()

    def keep(self) -> bool:
        """Write a snapshot of the run as it stands; whether there is one. The last one stays where this fails."""
        if not self.possible:
            return False
        position = Position(self.digest.events, self.digest.value, self._mapper.finished, self.refined)
        if position == self._last:
            return True
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._snapshot(position).write()
        except OSError as error:
            self.failed += 1
            if self.failed == 1:
                left = "the one before is kept" if self.path.exists() else "there is none"
                self._say(f"{self.path}: no snapshot can be written: {error.strerror}; {left}, and the run goes on")
            return False
        self.written += 1
        self._last = position
        return True

    def way_on(self) -> str:
        """What to add to a message about outputs that could not be written: how not to lose the work; "" for no way."""
        if not self.possible or not self.path.is_file():
            return ""
        return f"; `modp-ti run --resume {self.path.parent}` goes on from its snapshot, once that is mended"

    def remove(self) -> None:
        """The run is finished and needs it no longer, nor what a kill may have left half written."""
        for name in (FILE, FILE + ".partial"):
            self.path.with_name(name).unlink(missing_ok=True)

    def go_on_from(self, snapshot: Snapshot) -> None:
        """Take over what the snapshot knows of the run, the map apart. Raises InputError where it is not whole."""
        with snapshot.fitting():
            self.online = snapshot.online()
            self.refined = snapshot.position.refined
            self.resumed = int(snapshot.numbers["resumed"]) + 1
            self.written = int(snapshot.numbers["written"])
            self._clock.resume(float(snapshot.numbers["total"]), float(snapshot.numbers["mapping"]))
            snapshot.record(self._record)

    def _snapshot(self, position: Position) -> Snapshot:
        version, frames = version_state(self.online), frames_state(self._mapper.frames)
        of_map, record = self._mapper.pipeline.state(), record_state(self._record)
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

"""`Snapshot`: the complete state of a run as arrays and numbers; `Checkpointer`, which writes and copies them.

The file is an uncompressed .npz of plain arrays, one of which holds JSON. It contains no executable code.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.trajectory import Trajectory
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.results import RunClock
from modp_ti.files.atomic import replacing
from modp_ti.files.errors import InputError
from modp_ti.files.reading import open_file, reading
from modp_ti.files.run_folder import appearing
from modp_ti.files.storage import Storage, StorageError
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.outputs.evaluation import MapVersion
from modp_ti.outputs.report.record import FrameNote, RunRecord, StepNote
from modp_ti.version import __version__
from pipelines.state import MapState, save_state

FILE = "snapshot.npz"
# Version of the arrays and the JSON. Others are refused, as they hold the state of different code.
VERSION = 8
ABOUT = "about"
AGAIN = "; start the run from its scene"
UNKNOWN = np.full((3, 4), np.nan)
# Failures in a row after which nothing more is copied to `snapshot_store`, since each may take minutes.
TOO_MANY = 2


class StreamDigest:
    """Checksum of the tracker's frames and corrections, by which a resumed run knows that its input is the same.

    Attributes:
        value: CRC-32 of all frames and corrections so far, in order.
        events: Their number.
    """

    def __init__(self) -> None:
        self.value = 0
        self.events = 0
        self._images: dict[str, int] = {}  # checksums by name

    def add(self, event: TrackedFrame | PoseCorrection) -> None:
        """Add a frame or correction. The image of a held-out frame is left out, as it does not affect the map."""
        self.events += 1
        if isinstance(event, PoseCorrection):
            self._take(event.index, event.T_camera_world, event.ids, event.xyz)
            if event.camera is not None:
                self._images.clear()  # all images look different from now on
                self._take(event.camera.camera.matrix())
                self._take(*(array for array in (event.camera.lookup, event.camera.covered) if array is not None))
            return
        camera, points = event.camera, event.points
        self._images[event.name] = _checksum(event)
        self.value = zlib.crc32(event.name.encode("utf-8"), self.value)
        numbers = [event.index, event.timestamp, camera.fx, camera.fy, camera.cx, camera.cy]
        self._take(np.array(numbers, dtype=np.float64), event.T_camera_world, points.xyz, points.pixels, points.ids)
        if not event.held_out:
            self._take(event.rgba)

    def has_image_of(self, again: TrackedFrame) -> bool:
        """Return whether a frame that was read again has the image that it had."""
        return self._images.get(again.name) in (None, _checksum(again))

    def _take(self, *arrays: np.ndarray) -> None:
        for array in arrays:
            self.value = zlib.crc32(np.ascontiguousarray(array).data, self.value)


def _checksum(frame: TrackedFrame) -> int:
    return zlib.adler32(np.ascontiguousarray(frame.rgba).data)


@dataclass(frozen=True)
class Position:
    """The point in a run at which a snapshot was taken.

    Attributes:
        events: Number of frames and corrections that the tracker had delivered.
        digest: Their `StreamDigest`.
        finished: Whether `Mapper.finish` had run.
        refined: Number of finished refinement steps.
    """

    events: int
    digest: int
    finished: bool = False
    refined: int = 0


@dataclass(frozen=True)
class Snapshot:
    """The saved state of a run.

    Attributes:
        path: Where the file is, for messages.
        settings: The run's resolved settings, as JSON.
        position: The point in the run at which it was taken.
        arrays: Arrays with names of the form `group.name`.
        numbers: Everything else, as JSON.
        program: Version of the program that made it, None if the file does not say.
    """

    path: Path
    settings: dict[str, Any]
    position: Position
    arrays: dict[str, NDArray]
    numbers: dict[str, Any]
    program: object = __version__

    @property
    def map(self) -> MapState:
        return MapState(self.arrays, self.numbers["map"])

    def write(self, path: Path) -> None:
        """Write the file. The previous one is replaced once this one is on disk. Raises OSError if it is not."""
        about = {"settings": self.settings, "position": asdict(self.position), "numbers": self.numbers}
        text = json.dumps({"version": VERSION, "program": __version__, **about}).encode("utf-8")
        with replacing(path) as file:
            np.savez(file, allow_pickle=False, **self.arrays, **{ABOUT: np.frombuffer(text, dtype=np.uint8)})

    @classmethod
    def read(cls, path: Path) -> Snapshot:
        """Read a snapshot. Raises InputError with one line if the file is missing, damaged or of another version."""
        with reading(path, AGAIN):
            with open_file(path) as file, np.load(file, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
            about = json.loads(bytes(arrays.pop(ABOUT)))
            version, program = about["version"], about["program"]
            if version != VERSION:
                raise of_another_program(path, program, f"its format is {version}, and this program's {VERSION}")
            position = Position(**about["position"])
            return cls(path, dict(about["settings"]), position, arrays, dict(about["numbers"]), program)

    def number(self, *keys: str) -> float:
        """Return a count or a number of seconds."""
        value: Any = self.numbers
        for key in keys:
            value = value[key]
        return float(value)

    def frames(self, trajectory: Trajectory) -> DeliveredFrames:
        """Return the log of the frames, for the map whose trajectory is given."""
        columns = dict(self.numbers["frames"])
        columns["camera"] = [PinholeCamera(*row) for row in columns["camera"]]
        columns["origin"] = np.array(columns["origin"])
        frames = DeliveredFrames(**columns, trajectory=trajectory)
        frames.points.restore(MapState(self.arrays, {}).group("points"))
        return frames

    def online(self) -> MapVersion | None:
        """Return the map before refinement, or None if refinement had not begun."""
        state = MapState(self.arrays, self.numbers["online"] or {})
        gaussians, poses = state.group("online"), state.group("online_poses")
        if not gaussians:
            return None
        exposures = [None if np.isnan(row).all() else row for row in poses["exposure"]]
        return MapVersion(gaussians, list(poses["T"]), exposures, int(state.numbers["view_renders"]))

    def record(self, record: RunRecord) -> None:
        """Copy the saved notes into a new record."""
        record.frames = [FrameNote(*row) for row in self.numbers["notes"]["frames"]]
        record.steps = [StepNote(*row) for row in self.numbers["notes"]["steps"]]
        record.started = self.number("notes", "started")


def of_another_program(path: Path, program: object, difference: str) -> InputError:
    """Return the error for a snapshot of another version of the program, with its difference."""
    return InputError(
        f"{path}: MODP-Ti {program} has written this snapshot, and MODP-Ti {__version__} cannot resume it "
        f"({difference}); resume with that version, or start the run from its scene"
    )


def frames_state(frames: DeliveredFrames) -> MapState:
    """Inverse of `Snapshot.frames`."""
    columns = {name: getattr(frames, name) for name in ("index", "name", "timestamp", "held_out", "corrections")}
    cameras = [astuple(camera) for camera in frames.camera]
    return MapState.of(
        {"points": frames.points.state()}, columns | {"camera": cameras, "origin": frames.from_origin.tolist()}
    )


def version_state(version: MapVersion | None) -> MapState:
    """Inverse of `Snapshot.online`."""
    if version is None:
        return MapState({}, {})
    poses = {
        "T": np.array(version.trajectory).reshape(-1, 4, 4),
        "exposure": np.array([UNKNOWN if e is None else e for e in version.exposures]).reshape(-1, 3, 4),
    }
    return MapState.of({"online": version.gaussians, "online_poses": poses}, {"view_renders": version.view_renders})


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
        self._store = Storage(config.snapshot_store) if config.snapshot_store else None
        self._in_a_row = self._uncopied = 0  # failures of the storage
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
        self._copy()
        return True

    def _copy(self) -> None:
        """Copy the snapshot to `snapshot_store`. A storage that fails does not stop the run."""
        if self._store is None or self._in_a_row == TOO_MANY:
            return
        try:
            self._store.put(self.path, FILE)
            self._in_a_row = 0
        except StorageError as error:
            self._in_a_row += 1
            self._failed_to_copy(f"{error}; snapshots stay on this machine, and the run continues")

    def _failed_to_copy(self, what: str) -> None:
        self._uncopied += 1
        if self._uncopied == 1:
            self._say(what)

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
        try:
            if self._store is not None:
                self._store.remove(FILE)
        except StorageError as error:
            self._failed_to_copy(f"{error}; a snapshot of this finished run may be left there")

    def continue_from(self, snapshot: Snapshot) -> None:
        """Restore what a snapshot holds besides the map. Raises InputError if the snapshot is incomplete."""
        with reading(snapshot.path, AGAIN):
            self.online = snapshot.online()
            self.refined = snapshot.position.refined
            self.resumed = int(snapshot.number("resumed")) + 1
            self.written = int(snapshot.number("written"))
            self._clock.resume(snapshot.number("total"), snapshot.number("mapping"))
            snapshot.record(self._record)

    def _snapshot(self, position: Position) -> Snapshot:
        version, frames = version_state(self.online), frames_state(self._mapper.frames)
        of_map, record = save_state(self._mapper.online), self._record
        numbers = {
            "map": of_map.numbers,
            "frames": frames.numbers,
            "online": version.numbers,
            "watch": self._mapper.pipeline.stopwatch.seconds,
            "notes": {
                "frames": [astuple(note) for note in record.frames],
                "steps": [astuple(note) for note in record.steps],
                "started": record.started,
            },
            "total": self._clock.total,
            "mapping": self._clock.mapping,
            "resumed": self.resumed,
            "written": self.written + 1,
        }
        arrays = of_map.arrays | frames.arrays | version.arrays
        return Snapshot(self.path, self.config.model_dump(mode="json"), position, arrays, numbers)

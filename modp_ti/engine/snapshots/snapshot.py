"""`Snapshot`: the complete state of a run as arrays and numbers, with conversions to and from the run's objects.

The file is an uncompressed .npz of plain arrays, one of which holds JSON. It contains no executable code.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.trajectory import Trajectory
from modp_ti.files.atomic import replacing
from modp_ti.files.errors import InputError
from modp_ti.files.reading import open_file, reading
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.outputs.evaluation import MapVersion
from modp_ti.outputs.report.record import FrameNote, RunRecord, StepNote
from modp_ti.version import __version__
from pipelines.state import MapState

FILE = "snapshot.npz"
# Version of the arrays and the JSON. Others are refused, as they hold the state of different code.
VERSION = 6
ABOUT = "about"
AGAIN = "; start the run from its scene"
UNKNOWN = np.full((3, 4), np.nan)
# Saved columns of the record's frames and steps. None is saved as NaN.
FRAME_COLUMNS = {
    "index": np.int64,
    "held_out": np.bool_,
    "is_keyframe": np.bool_,
    "done": np.float64,
    "gaussians": np.int64,
    "psnr": np.float64,
    "mapped_psnr": np.float64,
}
STEP_COLUMNS = {"step": np.int64, "psnr": np.float64}


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

    @contextmanager
    def fitting(self) -> Iterator[None]:
        """Report what is raised in this context, where parts do not fit together, as an InputError of one line."""
        with reading(self.path, AGAIN):
            yield

    def number(self, *keys: str) -> float:
        """Return a count or a number of seconds."""
        value: Any = self.numbers
        for key in keys:
            value = value[key]
        return float(value)

    def frames(self, trajectory: Trajectory) -> DeliveredFrames:
        """Return the log of the frames, for the map whose trajectory is given."""
        state = MapState(self.arrays, self.numbers["frames"])
        rows, points = state.group("frames"), state.group("points")
        frames = DeliveredFrames(
            index=rows["index"].tolist(),
            name=list(state.numbers["name"]),
            timestamp=rows["timestamp"].tolist(),
            camera=[
                PinholeCamera(fx, fy, cx, cy, int(width), int(height))
                for fx, fy, cx, cy, width, height in rows["camera"].tolist()
            ],
            held_out=rows["held_out"].tolist(),
            trajectory=trajectory,
            corrections=dict(state.numbers["corrections"]),
            origin=np.array(state.numbers["origin"]),
        )
        frames.points.restore(points, frames.held_out)
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
        state = MapState(self.arrays, {})
        frames, steps = state.group("record"), state.group("record_steps")
        columns = {name: frames[name].tolist() for name in FRAME_COLUMNS}
        for name in ("psnr", "mapped_psnr"):
            columns[name] = [None if np.isnan(value) else value for value in columns[name]]
        record.frames = [FrameNote(*row) for row in zip(*columns.values(), strict=True)]
        record.steps = [StepNote(*row) for row in zip(*(steps[name].tolist() for name in STEP_COLUMNS), strict=True)]
        record.started = self.number("started")


def of_another_program(path: Path, program: object, difference: str) -> InputError:
    """Return the error for a snapshot of another version of the program, with its difference."""
    return InputError(
        f"{path}: MODP-Ti {program} has written this snapshot, and MODP-Ti {__version__} cannot resume it "
        f"({difference}); resume with that version, or start the run from its scene"
    )


def frames_state(frames: DeliveredFrames) -> MapState:
    """Inverse of `Snapshot.frames`."""
    cameras = [(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in frames.camera]
    rows = {
        "index": np.array(frames.index, dtype=np.int64),
        "timestamp": np.array(frames.timestamp, dtype=np.float64),
        "camera": np.array(cameras, dtype=np.float64).reshape(-1, 6),
        "held_out": np.array(frames.held_out, dtype=bool),
    }
    numbers = {"name": frames.name, "corrections": frames.corrections, "origin": frames.from_origin.tolist()}
    return MapState.of({"frames": rows, "points": frames.points.state()}, numbers)


def version_state(version: MapVersion | None) -> MapState:
    """Inverse of `Snapshot.online`."""
    if version is None:
        return MapState({}, {})
    poses = {
        "T": np.array(version.trajectory).reshape(-1, 4, 4),
        "exposure": np.array([UNKNOWN if e is None else e for e in version.exposures]).reshape(-1, 3, 4),
    }
    return MapState.of({"online": version.gaussians, "online_poses": poses}, {"view_renders": version.view_renders})


def record_state(record: RunRecord) -> MapState:
    """Inverse of `Snapshot.record`."""

    def arrays(notes: Sequence[FrameNote | StepNote], columns: Mapping[str, type]) -> dict[str, NDArray]:
        return {name: np.array([getattr(note, name) for note in notes], dtype=of) for name, of in columns.items()}

    groups = {"record": arrays(record.frames, FRAME_COLUMNS), "record_steps": arrays(record.steps, STEP_COLUMNS)}
    return MapState.of(groups, {})

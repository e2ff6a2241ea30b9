"""`Snapshot`: the complete state of a run as arrays and numbers, with conversions to and from the run's objects."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import NO_ORIGIN
from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.trajectory import Trajectory
from modp_ti.engine.snapshots.file import read_arrays, write_arrays
from modp_ti.files.reading import reading
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.outputs.evaluation import MapVersion
from modp_ti.outputs.report.record import FrameNote, RunRecord, StepNote
from modp_ti.version import __version__
from pipelines.state import MapState

__all__ = ["Position", "Snapshot", "StreamDigest", "frames_state", "record_state", "version_state"]

AGAIN = "; the parts of the snapshot do not fit together: start the run from its scene"
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
        """Write the file to this path. Raises OSError if it cannot be written."""
        about = {"settings": self.settings, "position": asdict(self.position), "numbers": self.numbers}
        write_arrays(path, self.arrays, about)

    @classmethod
    def read(cls, path: Path) -> Snapshot:
        """Read a snapshot. Raises InputError with one line if the file cannot be used."""
        arrays, about = read_arrays(path)
        with reading(path, AGAIN):
            position, settings, numbers = Position(**about["position"]), dict(about["settings"]), dict(about["numbers"])
            return cls(path, settings, position, arrays, numbers, about.get("program"))

    @contextmanager
    def fitting(self) -> Iterator[None]:
        """Report what is raised in this context, where parts do not fit together, as an InputError of one line."""
        with reading(self.path, AGAIN):
            yield

    def number(self, *keys: str) -> float:
        """Return a count or a number of seconds. Raises ValueError, TypeError or KeyError if it is neither."""
        value: Any = self.numbers
        for key in keys:
            value = value[key]
        number = float(value)
        if not 0.0 <= number < 1e11:
            raise ValueError(f"{keys[-1]}: {number} is no time and no count")
        return number

    def frames(self, trajectory: Trajectory) -> DeliveredFrames:
        """Return the metadata of the frames, for the map whose trajectory is given.

        Raises:
            KeyError, ValueError: If the metadata are incomplete or inconsistent.
        """
        state = MapState(self.arrays, self.numbers["frames"])
        rows, points = state.group("frames"), state.group("points")
        _require_columns(rows["index"], rows["timestamp"], rows["held_out"])
        if not all(isinstance(name, str) for name in state.numbers["name"]) or not np.isfinite(rows["camera"]).all():
            raise ValueError("a frame's name is no text, or its camera no camera")
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
            corrections={name: int(state.numbers["corrections"][name]) for name in ("received", "moved")},
            origin=np.array(state.numbers.get("origin", NO_ORIGIN), dtype=np.float64).reshape(3),
        )
        frames.points.restore(points, frames.held_out)
        if {len(part) for part in (frames.name, frames.timestamp, frames.camera)} != {len(frames)}:
            raise ValueError("the frames' names, times and cameras differ in number")
        self._require_like(frames_state(frames))
        return frames

    def _require_like(self, again: MapState) -> None:
        """Raise ValueError unless the arrays have the form in which the restored objects are written again."""
        for name, array in again.arrays.items():
            stored = self.arrays[name]
            kinds = {each.dtype.kind.replace("u", "i") for each in (stored, array)}
            if stored.shape != array.shape or len(kinds) > 1:
                raise ValueError(f"{name} is {stored.dtype} of shape {stored.shape}, not {array.dtype} {array.shape}")

    def online(self) -> MapVersion | None:
        """Return the map before refinement, or None if refinement had not begun."""
        state = MapState(self.arrays, self.numbers["online"] or {})
        gaussians, poses = state.group("online"), state.group("online_poses")
        if not gaussians:
            return None
        exposures = [None if np.isnan(row).all() else row for row in poses["exposure"]]
        version = MapVersion(gaussians, list(poses["T"]), exposures, int(state.numbers["view_renders"]))
        self._require_like(version_state(version))
        count, frames = len(gaussians["position"]), len(self.arrays["frames.index"])
        forms = {"position": (3,), "log_scale": (3,), "quaternion": (4,), "opacity_logit": ()}
        forms["sh"] = (*gaussians["sh"].shape[1:2], 3)
        if {len(poses["T"]), len(exposures)} != {frames} or any(
            gaussians[name].shape != (count, *form) for name, form in forms.items()
        ):
            raise ValueError("the map before refinement has another number of frames, or incomplete Gaussians")
        return version

    def record(self, record: RunRecord) -> None:
        """Copy the saved notes into a new record."""
        state = MapState(self.arrays, {})
        frames, steps = state.group("record"), state.group("record_steps")
        _require_columns(*frames.values(), *steps.values())
        columns = {name: frames[name].tolist() for name in FRAME_COLUMNS}
        for name in ("psnr", "mapped_psnr"):
            columns[name] = [None if np.isnan(value) else value for value in columns[name]]
        record.frames = [FrameNote(*row) for row in zip(*columns.values(), strict=True)]
        record.steps = [StepNote(*row) for row in zip(*(steps[name].tolist() for name in STEP_COLUMNS), strict=True)]
        record.started = self.number("started")
        self._require_like(record_state(record))


def _require_columns(*arrays: NDArray) -> None:
    if any(array.ndim != 1 for array in arrays):
        raise ValueError("a column of frames or steps has several dimensions")


def frames_state(frames: DeliveredFrames) -> MapState:
    """Inverse of `Snapshot.frames`."""
    cameras = [(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in frames.camera]
    rows = {
        "index": np.array(frames.index, dtype=np.int64),
        "timestamp": np.array(frames.timestamp, dtype=np.float64),
        "camera": np.array(cameras, dtype=np.float64).reshape(-1, 6),
        "held_out": np.array(frames.held_out, dtype=bool),
    }
    numbers = {"name": frames.name, "corrections": frames.corrections}
    if frames.from_origin.any():
        numbers["origin"] = frames.from_origin.tolist()
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

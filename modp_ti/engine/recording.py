"""Recording of a realtime run: all that arrived and all that was decided by the clock, so that it can be repeated."""

from __future__ import annotations

import io
import json
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import astuple
from functools import reduce
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import CameraRevision, PoseCorrection
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.engine.interruption import Interruption
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.stream import Conductor, FramesAhead
from modp_ti.files.errors import InputError
from modp_ti.files.reading import reading
from modp_ti.inputs.protocol import Event, Tracker
from modp_ti.inputs.sources import Picture
from pipelines.companions.pace import Plan, RecordedPace
from pipelines.refinement import Schedule
from pipelines.settings import MappingSettings, RefineSettings

FILE = "session.zip"
# Version of the file. Others are refused.
VERSION = 5
ABOUT = "about.json"
AGAIN = "; record the session again"
# What is written of a frame to `about.json`, and arrays of its points; arrays of a correction, and of its camera.
PLAIN = ("index", "timestamp", "name", "held_out", "depth_deviation", "arrived", "views")
POINTS = ("xyz", "pixels", "ids")
CORRECTION, REVISION = ("index", "T_camera_world", "ids", "xyz"), ("lookup", "covered")


class SessionRecorder:
    """Writes a session to a temporary file while it goes on.

    The file is a zip of one array file per frame or correction, in their order, and of `about.json` with the settings,
    the decisions, the measured times, and `events`: the plain values of each of them, with the number of further steps
    before it. Images are kept without loss. A full disk ends the recording, not the run.

    Attributes:
        problem: Why the session cannot be recorded, in one line; None if it can.
    """

    def __init__(self) -> None:
        self.problem: str | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="modp-ti-session-", ignore_cleanup_errors=True)
        self._file = Path(self._folder.name) / FILE
        self._zip = zipfile.ZipFile(self._file, "w", zipfile.ZIP_STORED)
        self._vignette: NDArray[np.float32] | None = None
        self._events: list[dict[str, Any]] = []
        self._further = 0
        self._shares: list[float] | None = None

    def add_further_step(self) -> None:
        """Count a step that was made before the next frame or correction."""
        self._further += 1

    def add_frame(self, frame: TrackedFrame) -> None:
        """Write a frame."""
        _, image = cv2.imencode(".png", frame.rgba, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        arrays = {"image": image} | {name: getattr(frame.points, name) for name in POINTS}
        if frame.vignette is not None and frame.vignette is not self._vignette:
            self._vignette = arrays["vignette"] = frame.vignette
        plain = {name: getattr(frame, name) for name in PLAIN}
        pose, camera = frame.T_camera_world.tolist(), astuple(frame.camera)
        self._write(arrays, **plain, T_camera_world=pose, camera=camera, masked=frame.mask is not None)

    def add_correction(self, correction: PoseCorrection, more: bool) -> None:
        """Write a correction. `more` is as in `Mapper.correct`."""
        arrays = {name: getattr(correction, name) for name in CORRECTION}
        revision, camera = correction.camera, None
        if revision is not None:
            camera = astuple(revision.camera)
            arrays |= {name: array for name in REVISION if (array := getattr(revision, name)) is not None}
        self._write(arrays, more=more, others_stay=correction.others_stay, camera=camera)

    def recorded(self, schedule: Schedule) -> Schedule:
        """Return the schedule of a refinement, and record what it says."""
        shares = self._shares = []

        def share(step: int) -> float | None:
            now = schedule(step)
            if now is not None:
                shares.append(now)
            return now

        return share

    def write(self, path: Path, plans: list[Plan | None], about: Mapping[str, Any]) -> None:
        """Complete the recording and copy it to a path.

        Args:
            path: The file to write.
            plans: Decisions of the pace.
            about: Settings and measured times, as JSON.
        """
        if self.problem is not None:
            return
        decisions = {
            "version": VERSION,
            "plans": [None if plan is None else [plan.pixels, plan.steps, plan.swept] for plan in plans],
            "events": self._events,
            "further": self._further,
            "refinement": self._shares,
        }
        try:
            self._zip.writestr(ABOUT, json.dumps({**decisions, **about}))
            self._zip.close()
            shutil.copyfile(self._file, path)
        except OSError as error:
            path.unlink(missing_ok=True)
            self._fail(path.parent, error)

    def close(self) -> None:
        """Delete the temporary file."""
        with suppress(OSError):  # closing completes the file, which may not fit on the disk
            self._zip.close()
        self._folder.cleanup()

    def _write(self, arrays: dict[str, NDArray], **plain: object) -> None:
        if self.problem is not None:
            return
        file = io.BytesIO()
        np.savez(file, allow_pickle=False, **arrays)
        try:
            self._zip.writestr(_name(len(self._events)), file.getvalue())
        except OSError as error:
            self._fail(Path(self._folder.name), error)
        self._events.append({"further": self._further, **plain})
        self._further = 0

    def _fail(self, place: Path, error: OSError) -> None:
        self.problem = f"the session is not recorded (export.session): {place}: {error.strerror}"


class RecordedSession(Tracker):
    """A `Tracker` that delivers the frames and corrections of a recorded session.

    Args:
        output: Output folder of the recorded run.

    Attributes:
        path: The file of the session.
        settings: Settings of the recorded run, as JSON.
        plans: Decisions of its pace.
        further: Number of further steps before each frame or correction, and before the end.
        more: Whether each correction was followed by another one at once, in order.
        shares: Schedule of its refinement; None if it followed the number of steps.

    Raises:
        InputError: If there is no recorded session, or it cannot be read.
    """

    reads_ahead: ClassVar[bool] = True
    corrects: ClassVar[bool] = True

    def __init__(self, output: Path) -> None:
        self.path = output / FILE
        if not self.path.is_file():
            raise InputError(f"{self.path}: there is no recorded session; record one with `export.session: true`")
        with reading(self.path, AGAIN):
            self._zip = zipfile.ZipFile(self.path)
            about = json.loads(self._zip.read(ABOUT))
            if about["version"] != VERSION:
                raise InputError(f"{self.path}: a session of version {about['version']}, this program reads {VERSION}")
            self.settings: dict[str, Any] = dict(about["settings"])
            self.plans = [
                None if plan is None else Plan(float(plan[0]), int(plan[1]), None if plan[2] is None else int(plan[2]))
                for plan in about["plans"]
            ]
            self.shares: list[float] | None = about["refinement"]
            self._events: list[dict[str, Any]] = about["events"]
            self.further = [*(event["further"] for event in self._events), int(about["further"])]
            self.more = [event["more"] for event in self._events if "more" in event]

    @property
    def notes(self) -> list[str]:
        return [f"repeats the session in {self.path}"]

    @property
    def frame_count(self) -> int:
        return len(self._events) - len(self.more)

    def pictures(self, names: Sequence[str]) -> Iterator[tuple[str, Picture]]:
        revising = [number for number, event in enumerate(self._events) if "more" in event and event["camera"]]
        corrections = (_correction(self._events[number], self._arrays(number)) for number in revising)
        later = [each.camera for each in corrections if each.camera is not None]
        wanted = set(names)
        for event in self:
            if isinstance(event, PoseCorrection):
                del later[: event.camera is not None]
            elif event.name in wanted:
                frame = reduce(TrackedFrame.with_camera, later, event)
                yield frame.name, Picture(frame.image, frame.mask, frame.vignette, frame.camera)

    def __iter__(self) -> Iterator[Event]:
        vignette = None
        for number, about in enumerate(self._events):
            with reading(self.path, AGAIN):
                arrays = self._arrays(number)
                vignette = arrays.get("vignette", vignette)
                event = _correction(about, arrays) if "more" in about else _frame(about, arrays, vignette)
            yield event

    def close(self) -> None:
        self._zip.close()

    def _arrays(self, number: int) -> dict[str, NDArray]:
        with np.load(io.BytesIO(self._zip.read(_name(number))), allow_pickle=False) as archive:
            return dict(archive)


def _name(number: int) -> str:
    return f"{number:06d}.npz"


def _frame(about: dict[str, Any], arrays: dict[str, NDArray], vignette: NDArray[np.float32] | None) -> TrackedFrame:
    rgba = cv2.imdecode(arrays["image"], cv2.IMREAD_UNCHANGED)
    if rgba is None or rgba.dtype != np.uint8:
        raise ValueError("its picture is damaged")
    return TrackedFrame(
        **{name: about[name] for name in PLAIN},
        image=np.divide(rgba[..., :3], np.float32(255.0), dtype=np.float32),
        camera=PinholeCamera(*about["camera"]),
        T_camera_world=np.array(about["T_camera_world"]),
        points=SparsePoints(**{name: arrays[name] for name in POINTS}),
        mask=rgba[..., 3] > 0 if about["masked"] else None,
        vignette=vignette,
    )


def _correction(about: dict[str, Any], arrays: dict[str, NDArray]) -> PoseCorrection:
    camera, revision = about["camera"], None
    if camera is not None:
        revision = CameraRevision(PinholeCamera(*camera), *(arrays.get(name) for name in REVISION))
    plain = {name: arrays[name] for name in CORRECTION}
    return PoseCorrection(**plain, camera=revision, others_stay=about["others_stay"])


class ReplayedRun(Conductor):
    """Repeats a recorded session: the same frames get the same work, whatever it costs now.

    Args:
        settings: Settings of the mapping.
        session: The recorded session, which is also the tracker.
    """

    def __init__(self, settings: MappingSettings, session: RecordedSession) -> None:
        super().__init__(RecordedPace(settings, session.plans))
        self._session = session
        self._more = iter(session.more)

    def events(
        self, ahead: FramesAhead[Event], mapper: Mapper, stop: Interruption, further: Callable[[], None]
    ) -> Iterator[Event]:
        counts = iter(self._session.further)

        def step() -> None:
            for _ in range(next(counts)):
                stop.check()
                mapper.online.optimise_further()
                further()

        step()
        for event in super().events(ahead, mapper, stop, further):
            yield event
            step()

    def correct(self, mapper: Mapper, correction: PoseCorrection) -> None:
        mapper.correct(correction, next(self._more))

    def schedule(self, settings: RefineSettings) -> Schedule | None:
        shares = self._session.shares
        return None if shares is None else lambda step: shares[step] if step < len(shares) else None

"""`EarlierMap`: the map that a run starts with, and `SecondVisit`, a finished one in which the recording is located."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.runtime.backend import initialise
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.snapshot import StreamDigest
from modp_ti.files.errors import InputError
from modp_ti.inputs.joined_tracker import JoinedTracker, Placement, prefix_for, shift_after
from modp_ti.inputs.protocol import Event, Tracker
from modp_ti.outputs.formats.run_files import read_exposures, read_masks
from modp_ti.outputs.locating.locator import Locator
from modp_ti.outputs.locating.world_alignment import (
    AGREEING,
    LEAST_POINTS,
    PlacedFrame,
    WorldAlignment,
    image_motion,
    world_alignment,
)
from modp_ti.outputs.playback.finished_run import FinishedRun, open_run
from modp_ti.outputs.playback.run_frames import FinishedFrames
from modp_ti.outputs.progress import ProgressLine
from pipelines.companions.changes import ChangeSweep, EarlierVisit
from pipelines.settings import RefineSettings
from pipelines.whole.finished_map import FinishedMap, go_on

# Located frames that settle the place of the recording.
SETTLING = 8
# Most frames that are tried and that wait for it.
MOST_TRIED, MOST_WAITING = 40, 240
# Least image motion between two frames that are tried, relative to the diagonal: frames from one place say little.
APART = 0.08


class EarlierMap:
    """The map that a run starts with: an empty one here; subclasses start with that of finished runs.

    Attributes:
        working: A few words on what `go_on` does, for the progress.
    """

    working = "starting with an empty map"

    def join(self, tracker: Tracker) -> Tracker:
        """Return the tracker of the run, whose first frames are those of the earlier map.

        Args:
            tracker: The opened tracker of the recording, whose events nobody has taken yet.

        Raises:
            InputError: If the recording does not fit the map.
        """
        return tracker

    def go_on(self, mapper: Mapper, arriving: Iterator[Event], digest: StreamDigest) -> None:
        """Take the frames of the earlier map from the tracker of the run, and put the map into the mapper.

        Args:
            mapper: A new mapper.
            arriving: The frames of the tracker that `join` has returned.
            digest: Takes what was taken from it.

        Raises:
            InputError: If the map does not fit the settings.
        """

    def recall(self, mapper: Mapper) -> None:
        """Give a restored mapper what it needs of the earlier map beside its own state.

        Args:
            mapper: The mapper of a resumed run.
        """

    def refinement(self, settings: RefineSettings) -> RefineSettings:
        """Return the settings of the refinement of the run's map, given those of the run. Call `join` before."""
        return settings

    @property
    def seconds(self) -> float:
        """Time that the frames of this recording took that are in the earlier map [s]."""
        return 0.0

    @property
    def notes(self) -> list[str]:
        """One-line remarks on the earlier map, for the user. They are available after `join`."""
        return []

    @property
    def metrics(self) -> dict[str, Any]:
        """The entries `onto` and `parts` of `metrics.json`, None without such a map."""
        return {"onto": None, "parts": None}


class SecondVisit(EarlierMap):
    """Finds the place of a recording in a finished map, and goes on with that map.

    The finished run's folder is only read.

    Args:
        config: The settings of the second recording, whose `onto` names the output folder of the finished run.
        line: Shows the progress.

    Raises:
        InputError: If there is no finished run, or a damaged one.
    """

    def __init__(self, config: SceneConfig, line: ProgressLine) -> None:
        assert config.onto is not None
        self._config = config
        self._line = line
        self._run = open_run(config.onto)
        self._earlier = FinishedFrames(self._run, line.prepare)
        self._alignment: WorldAlignment
        self.working = f"going on with {config.onto}"

    def join(self, tracker: Tracker) -> Tracker:
        """Locate the first frames of a tracker in the map. The device is started again.

        Args:
            tracker: The opened tracker of the second recording, whose events nobody has taken yet.

        Returns:
            A tracker of the frames of the finished run, and then those of the recording in the world of the map.

        Raises:
            InputError: If the recording cannot be located.
        """
        config, run, events = self._config, self._run, iter(tracker)
        locator = Locator(run.folder, config.device, self._line.console)
        taken, self._alignment = _settled(locator, events, self._line)
        initialise(config.device, config.mapper_threads, config.seed)  # frees what the locator has taken
        first = next(event for event in taken if isinstance(event, TrackedFrame))
        shift = shift_after(self._earlier.end, first.timestamp)
        S_world_tracker = self._alignment.S_map_tracker.copy()
        S_world_tracker[:3, 3] += run.record.origin
        placement = Placement(S_world_tracker, len(run), shift, prefix_for(run.names))
        return JoinedTracker(self._earlier, tracker, placement, taken, events)

    @property
    def notes(self) -> list[str]:
        """One line on how the recording was joined."""
        found = self._alignment
        return [
            f"joined to {self._run.folder}: {found.agreeing} of {found.placed} located frames agree within "
            f"{found.residual:.2f} px, at a scale of {found.scale:.5g}"
        ]

    @property
    def metrics(self) -> dict[str, Any]:
        found = self._alignment
        entry = {
            "frames": len(self._run),
            "located": found.placed,
            "agreeing": found.agreeing,
            "residual_px": round(found.residual, 4),
            "scale": found.scale,
        }
        return super().metrics | {"onto": entry}

    def go_on(self, mapper: Mapper, arriving: Iterator[Event], digest: StreamDigest) -> None:
        """Take the frames of the finished run from the joined tracker, and put its map into the mapper.

        Raises:
            InputError: If the map does not fit the settings.
        """

        def frames() -> Iterator[TrackedFrame]:
            for _ in range(len(self._run)):
                frame = next(arriving)
                assert isinstance(frame, TrackedFrame), "the finished run's frames come first"
                digest.add(frame)
                yield frame

        run = self._run
        mapper.frames.origin = run.record.origin
        try:
            go_on(mapper.online, finished_map(run, mapper.noted(frames())))
        except ValueError as error:
            raise InputError(
                f"{run.folder}: its map does not fit these settings ({error}); map both with the same ones"
            ) from None
        self.recall(mapper)

    def recall(self, mapper: Mapper) -> None:
        map_, earlier = mapper.online, EarlierVisit(self._run.gaussians, len(self._run))
        map_.companions.remove(map_.zero)  # the earlier map, which later views are compared with, keeps its brightness
        map_.companions.append(ChangeSweep(earlier, map_.gaussians, map_.keyframes, map_.renderer, map_.paging))


def finished_map(run: FinishedRun, frames: Iterable[TrackedFrame]) -> FinishedMap:
    """Return the map of a finished run.

    Args:
        run: The run.
        frames: Its frames, as for `FinishedMap`.
    """
    exposures, masks = read_exposures(run.folder / "exposure.json"), read_masks(run.folder / "masks")
    record = run.record
    return FinishedMap(run.gaussians, frames, set(record.keyframes), exposures, record.scene_depth, masks=masks)


def _settled(locator: Locator, events: Iterator[Event], line: ProgressLine) -> tuple[list[Event], WorldAlignment]:
    """Take frames until enough of them are located. Returns what was taken, and the alignment of the two worlds."""
    taken: list[Event] = []
    placed: list[PlacedFrame] = []
    last: TrackedFrame | None = None
    tried = 0
    reason = "it has no frame with tracked points"
    with line.working("locating the recording in the map"):
        for event in events:
            taken.append(event)
            if isinstance(event, PoseCorrection):
                placed = [_corrected(frame, event) for frame in placed]
            elif _is_worth_trying(event, last):
                last, tried = event, tried + 1
                found = locator.place(event)
                if isinstance(found, str):
                    reason = found
                else:
                    placed.append(found)
            ended = tried == MOST_TRIED or len(taken) == MOST_WAITING
            if ended or (len(placed) >= SETTLING and world_alignment(placed) is not None):
                break
        alignment = world_alignment(placed)
    if alignment is None:
        raise InputError(_not_located(len(placed), tried, reason))
    return taken, alignment


def _not_located(placed: int, tried: int, reason: str) -> str:
    if placed < AGREEING:
        said = f"{placed} of {tried} frames of the recording were located in the map, {AGREEING} are needed"
        return f"onto: {said} (the last was not: {reason}); begin the recording where the map is, or map it by itself"
    return (
        f"onto: the {placed} located frames of the recording do not agree on its place in the map: check its tracking, "
        "or map it by itself"
    )


def _is_worth_trying(frame: TrackedFrame, last: TrackedFrame | None) -> bool:
    """Whether a frame that may touch the map shows something else than the last one that was tried."""
    depth = frame.points.depths(frame.T_camera_world)
    depth = depth[depth > 0]
    if frame.held_out or len(depth) < LEAST_POINTS:
        return False
    if last is None:
        return True
    camera = frame.camera
    moved = image_motion(camera, float(np.median(depth)), last.T_camera_world, frame.T_camera_world)
    return moved > APART * float(np.hypot(camera.width, camera.height))


def _corrected(frame: PlacedFrame, correction: PoseCorrection) -> PlacedFrame:
    """Apply a correction of the tracker to a located frame."""
    T, xyz = frame.T_camera_tracker, frame.xyz.copy()
    at = np.flatnonzero(correction.index == frame.index)
    if len(at):
        T = correction.T_camera_world[at[0]]
    places = {number: place for place, number in enumerate(correction.ids.tolist())}
    for row, number in enumerate(frame.ids.tolist()):
        if number in places:
            xyz[row] = correction.xyz[places[number]]
    return replace(frame, T_camera_tracker=T, xyz=xyz)

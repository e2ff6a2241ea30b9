"""The parts of a run that its settings choose: the mapper, the conductor that takes the frames to it, the observer."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

from fields.geometry.camera import PinholeCamera
from modp_ti.config.settings import SceneConfig, ViewSettings
from modp_ti.engine.conductor import Conductor
from modp_ti.engine.earlier_map import EarlierMap
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.observer import Observer
from modp_ti.engine.realtime import RealtimeRun
from modp_ti.engine.recording import RecordedSession, ReplayedRun, SessionRecorder
from modp_ti.engine.second_visit import SecondVisit
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import PRIVATE
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.replay import ALL_HELD_OUT
from modp_ti.outputs.progress import ProgressLine
from pipelines.companions.pace import CompletePace, Pace

# The camera that the mapper of a realtime run is made for before the stream has opened. The images of most are smaller:
# `source.scale: auto` makes none of them larger than 480 pixels.
EXPECTED = PinholeCamera(640.0, 640.0, 320.0, 320.0, 640, 640)


def build_mapper(config: SceneConfig, camera: PinholeCamera, pace: Pace | None = None) -> Mapper:
    """Create the mapper for the scene's mode and for images of this camera.

    Args:
        config: The scene's settings.
        camera: The camera.
        pace: Pace of the online loop, None for all the work of the settings.

    Raises:
        InputError: If the settings do not fit the images.
    """
    settings = config.offline if config.mode == "offline" else config.mapping
    try:
        return Mapper(camera.width, camera.height, settings, config.seed, pace, config.output / PRIVATE)
    except ValueError as error:
        raise InputError(str(error)) from None


def open_earlier_map(config: SceneConfig, line: ProgressLine) -> EarlierMap:
    """Return the map that a run starts with.

    Args:
        config: The scene's settings.
        line: Shows the progress.

    Raises:
        InputError: If there is no finished run to go on with, or a damaged one.
    """
    if config.onto is not None:
        return SecondVisit(config, line)
    if config.parts is None:
        return EarlierMap()
    from modp_ti.many.merged_parts import MergedParts  # here, because it loads what many runs need

    return MergedParts(config)


def open_conductor(config: SceneConfig, tracker: Tracker, held: ExitStack) -> Conductor:
    """Return the conductor of a run: one that repeats a recorded session, follows the clock, or knows no clock.

    Args:
        config: The scene's settings.
        tracker: The tracker, or a recorded session.
        held: Closes the recording when the run ends.

    Raises:
        InputError: If the session cannot be recorded, or all frames are held out.
    """
    if isinstance(tracker, RecordedSession):
        return ReplayedRun(config.mapping, tracker)
    if not config.is_realtime:
        frames, every, views = tracker.frame_count, config.source.holdout, config.source.panorama.count
        held_out = 0 if frames is None or every is None else -(-frames // (every * views)) * views
        if frames and frames == held_out:
            raise InputError(ALL_HELD_OUT)
        return Conductor(CompletePace(config.mapping, None if frames is None else frames - held_out))
    recorder = None
    if config.export.session:
        recorder = SessionRecorder()
        held.callback(recorder.close)
    return RealtimeRun(config.mapping, tracker, recorder)


def open_observer(
    view: ViewSettings, say: Callable[..., None], insist: Callable[[str], None], held: ExitStack
) -> Observer:
    """Start the live viewer if the settings ask for it, and return what observes the run.

    Args:
        view: Settings of the viewer.
        say: Called with remarks for the user, which the report repeats.
        insist: Called with the address of the viewer, which nobody can guess.
        held: Closes the viewer when the run ends.
    """
    if not view.enabled:
        return Observer()
    from modp_ti.engine.live_viewer import LiveViewer  # here, because viser is an optional dependency

    viewer = LiveViewer(view, say)
    held.callback(viewer.close)
    insist(f"viewer: {viewer.page.address}")
    return viewer

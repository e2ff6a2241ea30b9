"""Parts: one recording, cut into overlapping parts that are mapped by tasks, and merged into one map."""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from rich.console import Console

from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import appearing, run_folder
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.inputs.scene_paths import refuse_output_in_input
from modp_ti.many.batch import LOGS, run_batch
from modp_ti.many.pool import open_pool
from modp_ti.many.scenes import Scene, for_a_task, with_store
from modp_ti.outputs.progress import ProgressLine
from pipelines.select.keyframes import SeenPoints, covisibility

# Least number of own frames of a part. A shorter one costs more to start than to map.
LEAST = 8
# How far a cut may lie from where the parts would be of equal length [shares of a part].
SLACK = 0.1
# Most frames that a part has beyond each of its ends [shares of a part].
MARGIN = 0.1
# Overlap with the frame at the cut, see `covisibility`, below which frames beyond it are of no use to a part.
SEES_TOO = 0.3


@dataclass(frozen=True)
class Part:
    """A part of a recording. Frames are named by their positions in it.

    Attributes:
        number: Number of the part, from 1.
        own: The frames that belong to it.
        frames: The frames that it is mapped from: its own, and those of its neighbours that see the same.
    """

    number: int
    own: range
    frames: range


def cut(views: Sequence[SeenPoints], parts: int) -> list[Part]:
    """Cut a recording into parts of about the same number of frames.

    Near where the parts would be equally long, each cut is made where the frames before and after it have the least in
    common. Each part also gets the frames beyond its cuts that see what its frames at the cut see.

    Args:
        views: What each frame sees.
        parts: Number of parts.

    Returns:
        The parts, in order. Each frame is an own frame of one of them.

    Raises:
        InputError: If the recording is too short for so many parts.
    """
    if len(views) < LEAST * parts:
        most = len(views) // LEAST
        instead = f"at most {most} parts" if most >= 2 else "no parts"
        raise InputError(f"the recording has {len(views)} frames, too few for {parts} parts: take {instead}")
    length = len(views) / parts
    margin = max(int(MARGIN * length), 1)
    slack = int(SLACK * length)
    cuts = [_best_cut(views, round(number * length), slack, margin) for number in range(1, parts)]
    ends = [0, *cuts, len(views)]
    return [
        Part(
            number,
            range(first, end),
            range(_before(views, first, margin), _after(views, end, margin)),
        )
        for number, (first, end) in enumerate(pairwise(ends), start=1)
    ]


def _best_cut(views: Sequence[SeenPoints], middle: int, slack: int, margin: int) -> int:
    """Return the position of the first frame after a cut near the middle.

    The frames a margin before and after it have the least in common. Of cuts where they have as little, that is taken
    whose two frames have the least, and then the nearest to the middle.
    """

    def common(place: int) -> tuple[float, float, int]:
        apart = covisibility(views[place - margin], views[place + margin - 1])
        return apart, covisibility(views[place - 1], views[place]), abs(place - middle)

    return min(range(middle - slack, middle + slack + 1), key=common)


def _before(views: Sequence[SeenPoints], first: int, margin: int) -> int:
    """Return the position of the first frame of a part whose own frames begin at `first`."""
    place = first
    while place > max(first - margin, 0) and covisibility(views[place - 1], views[first]) >= SEES_TOO:
        place -= 1
    return place


def _after(views: Sequence[SeenPoints], end: int, margin: int) -> int:
    """Return the position after the last frame of a part whose own frames end before `end`."""
    place = end
    while place < min(end + margin, len(views)) and covisibility(views[end - 1], views[place]) >= SEES_TOO:
        place += 1
    return place


# Folder of the parts in the output folder.
FOLDER = "parts"
# Share of the steps of a keyframe that it gets in its part. The refinement of the merged map gets the others: a part
# optimises what the merged map takes from another one as well, and the seams need the steps.
IN_PART = 0.25


def parts_of(tracker: Tracker, config: SceneConfig) -> list[Part]:
    """Cut the recording of a tracker into the parts of the settings.

    Raises:
        InputError: If it is too short for them.
    """
    assert isinstance(tracker, ReplayedTracker) and config.parts is not None, "SceneConfig refuses others"
    seen = [SeenPoints(frame.undistorter.camera, frame.T_camera_world, frame.points.xyz) for frame in tracker.frames]
    return cut(seen, config.parts)


def part_scenes(tracker: Tracker, config: SceneConfig) -> list[Scene]:
    """Return the parts of a recording as the scenes of a batch.

    Args:
        tracker: The opened tracker of the whole recording. A model that it has made is given to the parts.
        config: The settings of the whole recording.

    Raises:
        InputError: If the recording is too short for so many parts.
    """
    parts = parts_of(tracker, config)
    runs = [(f"part-{part.number}", for_a_task(part_config(config, part))) for part in parts]
    scenes = [Scene(name, run.output, run) for name, run in runs]
    if config.tracker.kind == "sfm":
        for scene in scenes:
            assert scene.config is not None
            with appearing(scene.config.output, ("sfm",)) as staged:
                shutil.copytree(config.output / "sfm", staged / "sfm")
    return scenes


def part_config(config: SceneConfig, part: Part) -> SceneConfig:
    """Return the settings of the run of a part. Refinement, scores and reports are for the merged map."""
    source = config.source.model_copy(update={"part": (part.frames.start, part.frames.stop)})
    optimise = config.mapping.optimise.model_copy(update={"steps": steps_in_part(config)})
    return config.model_copy(
        update={
            "source": source,
            "mapping": config.mapping.model_copy(update={"optimise": optimise}),
            "parts": None,
            "output": config.output / FOLDER / str(part.number),
            "refine": config.refine.model_copy(update={"steps": 0, "seconds": None}),
            "evaluation": config.evaluation.model_copy(update={"scores": False}),
            "export": config.export.model_copy(update={"images": False, "report": False}),
        }
    )


def steps_in_part(config: SceneConfig) -> int:
    """Return the steps of a keyframe in its part: all of them without a refinement of so many steps."""
    steps = config.mapping.optimise.steps
    return math.ceil(IN_PART * steps) if config.refine.wanted and config.refine.seconds is None else steps


def map_in_parts(
    config: SceneConfig, engine: str = "local", address: str | None = None, console: Console | None = None
) -> Path:
    """Map a recording in the parts of its settings, and write its output folder as `run_scene` does.

    The parts are mapped to `parts/1`, `parts/2`, ... in the output folder. Parts that are finished, with these
    settings, are not mapped again.

    Args:
        config: The settings of the recording, with `parts`.
        engine: What carries out the runs of the parts: "local" for processes on this machine, "ray" for a Ray cluster.
        address: Address of the Ray cluster, see `RayPool`.
        console: Receives progress and notes, None for no output.

    Returns:
        The output folder.

    Raises:
        InputError: If the input cannot be used, or a part cannot be mapped.
        KeyboardInterrupt: After Ctrl-C, when the parts have saved what they had.
    """
    console = console or Console(quiet=True)
    refuse_output_in_input(config)
    with run_folder(config.output):
        _map_parts(config, engine, address, console)
        from modp_ti.engine.session import run_scene  # here, so that the parts' processes have the memory until then

        return run_scene(config, console)


def _map_parts(config: SceneConfig, engine: str, address: str | None, console: Console) -> None:
    """Map the parts that are not mapped."""
    with closing(open_tracker(config, ProgressLine(console).prepare)) as tracker:
        scenes = part_scenes(tracker, config)
    if config.snapshot_store:
        scenes = with_store(scenes, config.snapshot_store)
    folder = config.output / FOLDER
    with open_pool(engine, folder / LOGS, address) as pool:
        results = run_batch(scenes, pool, folder, console=console)
    failed = [result for result in results if not result.state.is_done]
    if failed:
        raise InputError(f"{failed[0].name}: {failed[0].error}; the same command maps the parts that are left")

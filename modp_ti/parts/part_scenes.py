"""The parts of a recording as scenes of their own."""

from __future__ import annotations

import math
import shutil

from fields.map.covisibility import SeenPoints
from modp_ti.batch.scenes import Scene, for_a_task
from modp_ti.config.settings import SceneConfig
from modp_ti.files.run_folder import appearing
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.parts.cutting import Part, cut

__all__ = ["FOLDER", "part_config", "part_scenes", "parts_of", "steps_in_part"]

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

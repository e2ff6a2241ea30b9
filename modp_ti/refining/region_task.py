"""The work of a task of `modp-ti refine`: one round of refinement of one region."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from modp_ti.config.scene_file import scene_from_data
from modp_ti.files.errors import InputError
from modp_ti.tasks import Report

if TYPE_CHECKING:
    from pipelines.regions.refinement import RefinedRegion, Span

__all__ = ["RegionJob", "RegionResult", "refine_region_of"]


@dataclass(frozen=True)
class RegionJob:
    """What a task gets.

    Attributes:
        settings: The settings of the run as plain data, with absolute paths.
        folder: Output folder of the finished run. Its frames are read from there.
        number: Number of the task, unique in the refinement, from 0. With the seed of the settings, it determines the
            random draws.
        gaussians: The Gaussians of the region and around it, with their optimiser state.
        own: Whether each of them (N,) belongs to the region.
        exposures: Exposure (3, 4) of frames by position, where one is estimated.
        views: Ascending positions of the mapped frames that see the region. Those that become views of the map are so
            here.
        span: The steps.
    """

    settings: dict[str, Any]
    folder: Path
    number: int
    gaussians: dict[str, NDArray]
    own: NDArray
    exposures: dict[int, NDArray]
    views: list[int]
    span: Span


@dataclass(frozen=True)
class RegionResult:
    """What a task returns.

    Attributes:
        region: The refined region.
        cpu_seconds: Time of the processor [s].
        seconds: Time [s].
        memory_mb: Largest resident set of the process [MB], None if it is not known.
    """

    region: RefinedRegion
    cpu_seconds: float
    seconds: float
    memory_mb: float | None


def refine_region_of(job: RegionJob, report: Report) -> RegionResult:
    """Carry out a job.

    Args:
        job: The job.
        report: Called with (steps done, mean PSNR of the last step's views).

    Raises:
        InputError: If the frames cannot be read, or the region does not fit the settings.
    """
    # Imported here: the command line makes these tasks without loading Taichi.
    from fields.runtime.backend import initialise
    from modp_ti.engine.build import build_mapper
    from modp_ti.engine.run_clock import peak_memory_mb
    from modp_ti.outputs.formats.keyframe_masks import read_masks
    from modp_ti.outputs.playback.finished_frames import frames_of
    from modp_ti.outputs.playback.finished_run import open_run
    from pipelines.finished_map import FinishedMap
    from pipelines.online import OnlineMapper
    from pipelines.regions.refinement import refine_region

    began = time.perf_counter()
    config, run = scene_from_data(job.settings, "the run"), open_run(job.folder)
    seed = config.seed + job.number
    try:
        initialise(config.device, config.mapper_threads, seed)
    except RuntimeError as error:
        raise InputError(str(error)) from None
    mapper = build_mapper(config.model_copy(update={"seed": seed}), run.cameras[0].resized(*run.size)).pipeline
    assert isinstance(mapper, OnlineMapper), "`refine` refuses other maps"
    finished = FinishedMap(
        job.gaussians,
        frames_of(run, job.views),
        set(run.record.keyframes),
        job.exposures,
        run.record.scene_depth,
        masks=read_masks(run.folder / "masks"),
    )
    try:
        region = refine_region(
            mapper, finished, job.own, config.refine, job.span, lambda step, psnr: report((step, psnr))
        )
    except ValueError as error:
        raise InputError(f"the region cannot be refined ({error}): take more --regions") from None
    return RegionResult(region, time.process_time(), time.perf_counter() - began, peak_memory_mb())

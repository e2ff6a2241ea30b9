"""Writes `report.html` from a run's record."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import camera_centres
from modp_ti.config.settings import SceneConfig
from modp_ti.files.atomic import replace_text
from modp_ti.outputs.evaluation import FrameScore, MapVersion, umeyama
from modp_ti.outputs.report import facts, plots
from modp_ti.outputs.report.pictures import FULL_SCALE, Comparison, as_uri, error_colours
from modp_ti.outputs.report.plan import floor_plan, plan_of
from modp_ti.outputs.report.record import RunRecord

__all__ = ["ReportedRun", "show_link_to_map", "write_report"]

# The link to the page that `modp-ti export --format html` writes, hidden while there is none.
MAP_PAGE = "map.html"
HIDDEN_LINK, SHOWN_LINK = '<p id="map" hidden>', '<p id="map">'


@dataclass(frozen=True)
class ReportedRun:
    """The data of a report.

    Attributes:
        config: The scene's settings.
        record: Notes taken during the run.
        metrics: Content of metrics.json.
        scores: Scores of all frames in all versions.
        versions: Map versions by name; the last one is the final map.
        tracked: The tracker's T_camera_world (4, 4) of every frame.
        truth: Ground-truth T_camera_world (4, 4) of every frame, or empty.
        keyframes: Positions of the keyframes among the frames.
        scene_depth: The scene's depth [scene units].
        comparisons: Frames next to renders of the final map.
    """

    config: SceneConfig
    record: RunRecord
    metrics: Mapping[str, Any]
    scores: Sequence[FrameScore]
    versions: Mapping[str, MapVersion]
    tracked: Sequence[NDArray[np.float64]]
    truth: Sequence[NDArray[np.float64]]
    keyframes: Sequence[int]
    scene_depth: float
    comparisons: Sequence[Comparison]


def write_report(path: Path, run: ReportedRun) -> None:
    """Write the page. It is self-contained: a browser loads nothing else for it."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("modp_ti.outputs.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template("page.html.j2").render(
        run=run,
        facts=facts,
        folders=facts.scene_folders(run.config),
        name=run.config.output.name,
        started=time.strftime("%d %B %Y, %H:%M", time.localtime(run.record.started)),
        stage=facts.last_stage(run.metrics),
        maps=[stage for stage in ("online", "refined", "offline") if run.metrics[stage] is not None],
        remarks=facts.remarks(run.metrics, run.record.notes),
        drawings={name: as_uri("svg+xml", svg.encode("utf-8")) for name, svg in _drawings(run).items()},
        scale=_scale(),
        full_scale=FULL_SCALE,
        map_page=MAP_PAGE,
    )
    replace_text(path, page)
    if (path.parent / MAP_PAGE).exists():
        show_link_to_map(path)


def show_link_to_map(path: Path) -> None:
    """Show the link to `map.html` in a report that was written before it. Does nothing without a report."""
    if path.is_file():
        page = path.read_text("utf-8")
        if HIDDEN_LINK in page:
            replace_text(path, page.replace(HIDDEN_LINK, SHOWN_LINK))


def _drawings(run: ReportedRun) -> dict[str, str]:
    """Return the SVG of every drawing that the run has data for."""
    last = list(run.versions.values())[-1]
    plan = plan_of(last.trajectory)
    floor = floor_plan(plan, last.gaussians, camera_centres(last.trajectory))
    drawings = {}
    if run.scores or any(note.mapped_psnr is not None for note in run.record.frames):
        drawings["psnr"] = plots.psnr_of_frames(run.scores, run.record.frames)
    if run.record.frames and run.config.mode == "online":
        drawings["growth"] = plots.growth(run.record.frames)
    if any(note.lag is not None for note in run.record.frames):
        drawings["pace"] = plots.pace(run.record.frames)
    if run.record.steps:
        drawings["steps"] = plots.steps(run.record.steps)
    truth = _aligned(run.truth, last.trajectory)
    drawings["trajectory"] = plots.trajectory(plan, run.tracked, last.trajectory, run.keyframes, floor, truth)
    if run.config.mode == "online":
        ways = {name: version.trajectory for name, version in run.versions.items()}
        drawings["poses"] = plots.pose_changes(run.tracked, ways, run.scene_depth)
    return drawings


def _aligned(
    truth: Sequence[NDArray[np.float64]], estimate: Sequence[NDArray[np.float64]]
) -> NDArray[np.float64] | None:
    """Align the true camera centres (N, 3) to the estimate by the best similarity. None without ground truth."""
    if len(truth) != len(estimate) or len(truth) < 3:
        return None
    there = camera_centres(truth)
    known = np.isfinite(there).all(axis=1)
    s, R, t = umeyama(there[known], camera_centres(estimate)[known])
    return s * there @ R.T + t


def _scale() -> str:
    """Return the colour scale of the error maps, from 0 to FULL_SCALE, as a data URI."""
    strip = error_colours(np.linspace(0.0, FULL_SCALE, 128, dtype=np.float32)[None])
    _, data = cv2.imencode(".png", np.ascontiguousarray(strip[..., ::-1]))
    return as_uri("png", data.tobytes())

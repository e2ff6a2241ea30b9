"""Writes `report.html` from a run's record, with comparisons of frames and renders."""

from __future__ import annotations

import base64
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import camera_centres
from modp_ti.config.settings import SceneConfig
from modp_ti.files.atomic import replace_text
from modp_ti.files.errors import InputError
from modp_ti.outputs.evaluation import FrameScore, MapVersion, summary, umeyama
from modp_ti.outputs.playback.map_renderer import eight_bits
from modp_ti.outputs.report import facts, from_above, plots
from modp_ti.outputs.report.record import RunRecord
from modp_ti.outputs.report.where_wrong import ErrorSurvey, Needles
from pipelines.whole.coverage import SeenDepth, where_to_film, widest_angles

# Error at which the colour scale ends.
FULL_SCALE = 0.2
# Number of frames shown, and how many of them are the worst ones. The others are spread evenly over the ranks up to the
# best.
SHOWN = 7
WORST = 3
# Longer side of a picture in the page [px], and its JPEG quality.
LONGEST = 480
QUALITY = 85
# The link to the page that `modp-ti export --format html` writes, hidden while there is none.
MAP_PAGE = "map.html"
HIDDEN_LINK, SHOWN_LINK = '<p id="map" hidden>', '<p id="map">'


@dataclass(frozen=True)
class Comparison:
    """A frame, the render from its pose, and their difference, each as a data URI.

    Attributes:
        score: The frame's score in the map shown.
        rank: "worst", "median", "best" or empty.
        frame: The frame's image.
        render: The render.
        error: The error map.
    """

    score: FrameScore
    rank: str
    frame: str
    render: str
    error: str


@dataclass
class Album:
    """Keeps 8-bit copies of the frames and renders that a report may show.

    Attributes:
        wanted: Indices of the frames to keep.
        kept: Image and render by index.
    """

    wanted: frozenset[int]
    kept: dict[int, tuple[NDArray[np.uint8], NDArray[np.uint8]]] = field(default_factory=dict)

    @classmethod
    def of(cls, held_out: Sequence[bool]) -> Album:
        """Create an album for a run.

        With held-out frames it keeps nothing, as their pictures are in the `renders` folder. Otherwise it keeps a few
        frames.

        Args:
            held_out: Whether each frame is held out.
        """
        if any(held_out):
            return cls(frozenset())
        return cls(frozenset(np.linspace(0, len(held_out) - 1, min(SHOWN, len(held_out))).round().astype(int).tolist()))

    def keep(self, index: int, image: NDArray[np.float32], render: NDArray[np.float32]) -> None:
        """Store the image and render (H, W, 3), in [0, 1], if the frame is wanted."""
        if index in self.wanted:
            self.kept[index] = eight_bits(image), eight_bits(render)

    def comparisons(self, scores: Iterable[FrameScore], renders: Path) -> list[Comparison]:
        """Return the comparisons of the page, worst first.

        Args:
            scores: Scores of one map version.
            renders: Folder with the pictures of the held-out frames.
        """
        scores = list(scores)
        held_out = [score for score in scores if score.held_out]
        comparisons = []
        for score, rank in picked(held_out or [score for score in scores if score.index in self.kept]):
            if score.index in self.kept:
                image, render = self.kept[score.index]
            else:  # side by side
                path = renders / f"{score.index:06d}.png"
                pair = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
                if pair is None:
                    raise InputError(f"{path}: the picture is missing or damaged; run again to write it")
                image, render = np.hsplit(np.asarray(pair, dtype=np.uint8), 2)
            error = np.abs(image.astype(np.float32) - render.astype(np.float32)).mean(axis=2) / 255.0
            comparisons.append(Comparison(score, rank, *map(_jpeg, (image, render, error_colours(error)))))
        return comparisons


def picked(scores: Sequence[FrameScore]) -> list[tuple[FrameScore, str]]:
    """Choose at most SHOWN scores: the worst ones, then evenly spaced ranks up to the best.

    Returns:
        The scores with their rank in words, which may be empty.
    """
    order = sorted(scores, key=lambda score: (score.psnr, score.index))
    last = len(order) - 1
    places = list(range(min(WORST, len(order))))
    if last >= WORST:
        places += np.linspace(WORST - 1, last, SHOWN - WORST + 1).round().astype(int)[1:].tolist()
        if last >= SHOWN - 1:
            places[WORST] = last // 2
    words = {last // 2: "median", last: "best", 0: "worst"} if last > 1 else {}
    return [(order[place], words.get(place, "")) for place in sorted(set(places))]


def error_colours(error: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Map errors (H, W) to RGB colours (H, W, 3), from black for 0 to pale yellow for FULL_SCALE and more."""
    return np.asarray(cv2.applyColorMap(eight_bits(error / FULL_SCALE), cv2.COLORMAP_INFERNO), np.uint8)[..., ::-1]


def _jpeg(picture: NDArray[np.uint8]) -> str:
    """Encode a picture (H, W, 3) RGB as a JPEG data URI, scaled down to sides of at most LONGEST pixels."""
    height, width = picture.shape[:2]
    factor = LONGEST / max(height, width)
    if factor < 1.0:
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    return _uri("jpeg", cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), options)[1].tobytes())


def _uri(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


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
        survey: Where the final map is wrong.
        needles: The needles of the final map.
        seen: What some of the cameras see of the final map.
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
    survey: ErrorSurvey
    needles: Needles
    seen: Sequence[SeenDepth] = ()


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
    strip = error_colours(np.linspace(0.0, FULL_SCALE, 128)[None])[..., ::-1]
    page = environment.get_template("page.html.j2").render(
        run=run,
        facts=facts,
        folders=facts.scene_folders(run.config),
        name=run.config.output.name,
        started=time.strftime("%d %B %Y, %H:%M", time.localtime(run.record.started)),
        stage=facts.last_stage(run.metrics),
        maps=[stage for stage in ("online", "refined", "offline") if run.metrics[stage] is not None],
        compared=facts.side_by_side(run.metrics),
        no_scores=summary([]),
        remarks=facts.remarks(run.metrics, run.record.notes),
        drawings={name: _uri("svg+xml", svg.encode("utf-8")) for name, svg in _drawings(run).items()},
        scale=_uri("png", cv2.imencode(".png", np.ascontiguousarray(strip))[1].tobytes()),
        full_scale=FULL_SCALE,
        map_page=MAP_PAGE,
    )
    replace_text(path, page)
    if (path.parent / MAP_PAGE).exists():
        show_link_to_map(path)


def show_link_to_map(path: Path) -> None:
    """Show the link to `map.html` in a report that was written before it. Does nothing without a report."""
    if path.is_file():
        replace_text(path, path.read_text("utf-8").replace(HIDDEN_LINK, SHOWN_LINK))


def _drawings(run: ReportedRun) -> dict[str, str]:
    """Return the SVG of every drawing that the run has data for."""
    last = list(run.versions.values())[-1]
    centres, frames, online = camera_centres(last.trajectory), run.record.frames, run.config.mode == "online"
    plan = from_above.plan_of(last.trajectory)
    floor = from_above.floor_plan(plan, last.gaussians, centres)
    truth = None
    if len(run.truth) == len(centres) >= 3:
        true = camera_centres(run.truth)
        known = np.isfinite(true).all(axis=1)
        s, R, t = umeyama(true[known], centres[known])
        truth = s * true @ R.T + t
    ways = {name: version.trajectory for name, version in run.versions.items()}
    has_psnr = bool(run.scores) or any(note.mapped_psnr is not None for note in frames)
    drawn = {
        "psnr": has_psnr and (plots.psnr_of_frames, run.scores, frames),
        "growth": bool(frames) and online and (plots.growth, frames),
        "pace": any(note.lag is not None for note in frames) and (plots.pace, frames),
        "steps": bool(run.record.steps) and (plots.steps, run.record.steps),
        "place": bool(run.survey.by_depth()) and (plots.places, *run.survey.by_place(), run.survey.aspect),
        "thin": bool(run.seen) and (from_above.coverage, *_thin(run, plan, floor[0], centres)),
        "trajectory": (from_above.trajectory, plan, run.tracked, last.trajectory, run.keyframes, floor, truth),
        "poses": online and (plots.pose_changes, run.tracked, ways, run.scene_depth),
    }
    return {name: plots.svg(*drawing) for name, drawing in drawn.items() if drawing}


def _thin(
    run: ReportedRun, plan: NDArray[np.float64], floor: NDArray[np.float64], centres: NDArray[np.float64]
) -> tuple[Any, ...]:
    """Return the values of `from_above.coverage`."""
    points = floor @ plan
    angles = widest_angles(points, run.seen, run.scene_depth)
    film = where_to_film(points, angles, run.seen)
    on_page = None if film is None else (plan[:2] @ film[0], plan[:2] @ film[1])
    return centres @ plan[:2].T, floor[:, :2], angles, on_page

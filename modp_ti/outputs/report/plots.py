"""The report's drawings. Each function returns an SVG as text."""

from __future__ import annotations

import functools
import io
import logging
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ParamSpec

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import camera_centres
from modp_ti.outputs.evaluation import FrameScore
from modp_ti.outputs.report.curves import binned, frame_rate, shifts_and_turns
from modp_ti.outputs.report.plan import Plan
from modp_ti.outputs.report.record import FrameNote, StepNote

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["growth", "pace", "pose_changes", "psnr_of_frames", "steps", "trajectory"]

Arguments = ParamSpec("Arguments")

WIDTH = 9.2  # inches; the page scales it
PANEL = 1.15  # width over height of a view from above
# Colours that differ in print and for colour-blind readers (Okabe and Ito).
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
OF_STAGE = {"online": BLUE, "refined": ORANGE, "offline": ORANGE}
STYLE = {
    "svg.fonttype": "none",  # text stays text
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
    "figure.constrained_layout.use": True,
}


def _drawn(draw: Callable[Arguments, Figure]) -> Callable[Arguments, str]:
    """Decorator that turns a function returning a figure into one returning its SVG."""

    @functools.wraps(draw)
    def svg(*values: Arguments.args, **named: Arguments.kwargs) -> str:
        # Imported here so that a run does not wait for matplotlib at its start. The message about building its font
        # cache, once per machine, does not concern the user.
        logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)
        import matplotlib.style

        file = io.StringIO()
        with matplotlib.style.context(["default", STYLE]):  # ignore the user's matplotlib settings
            about = dict.fromkeys(("Date", "Creator", "Format", "Type"))
            draw(*values, **named).savefig(file, format="svg", dpi=130, metadata=about)
        return file.getvalue()

    return svg


def _panels(height: float, rows: int = 1, columns: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a figure with panels of this height [inches]. Panels above each other share their x axis."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, rows * height))
    return figure, figure.subplots(rows, columns, sharex=rows > 1, squeeze=False).ravel().tolist()


@_drawn
def psnr_of_frames(scores: Sequence[FrameScore], frames: Sequence[FrameNote] = ()) -> Figure:
    """Plot the PSNR of every frame in each version of the map, with held-out frames as dots.

    Args:
        scores: Scores of all frames in all versions.
        frames: The run's frames; the PSNR of keyframes soon after they were mapped is drawn below the versions'.
    """
    figure, (axes,) = _panels(3.0)
    if mapped := [note for note in frames if note.mapped_psnr is not None]:
        x, y = _xy(mapped, "index", "mapped_psnr")
        _line(axes, x, y, "psnr-mapped", color=GREY, lw=1.0, label="keyframes, just mapped")
    for stage in dict.fromkeys(score.stage for score in scores):
        of = [score for score in scores if score.stage == stage]
        x, y = _xy(of, "index", "psnr")
        _line(axes, x, y, f"psnr-{stage}", color=OF_STAGE[stage], label=stage)
        held_out = np.array([score.held_out for score in of])
        if held_out.any():
            axes.plot(x[held_out], y[held_out], "o", ms=3.2, color=OF_STAGE[stage], label=f"{stage}, held out")
    _label(axes, "frame", "PSNR [dB]")
    if axes.has_data():
        axes.legend(ncols=4, loc="lower right", bbox_to_anchor=(1, 1))
    return figure


@_drawn
def growth(frames: Sequence[FrameNote]) -> Figure:
    """Plot the number of Gaussians, frames per second and the PSNR of the optimised views over the frames."""
    mapped = [note for note in frames if note.psnr is not None]
    window = max(5, len(frames) // 20)
    figure, axes = _panels(1.75, 3 if mapped else 2)
    x, count = _xy(frames, "index", "gaussians")
    _gaussians(axes[0], x, count, "gaussians")
    keyframes = [note for note in frames if note.is_keyframe]
    if len(keyframes) < len(frames):
        axes[0].plot(*_xy(keyframes, "index", "gaussians"), ".", ms=4, color=BLUE, label="keyframes")
        axes[0].legend(loc="upper left")
    _line(axes[1], x, frame_rate(frames, window), "frame-rate", color=GREEN)
    axes[1].set_yscale("log")  # frames that are not keyframes are a hundred times faster
    _label(axes[1], "" if mapped else "frame", f"frames per second\n(last {window})")
    if mapped:
        _line(axes[2], *_xy(mapped, "index", "psnr"), "view-psnr", color=ORANGE)
        _label(axes[2], "frame", "PSNR of the views\nbeing optimised [dB]")
    return figure


@_drawn
def pace(frames: Sequence[FrameNote]) -> Figure:
    """Plot lag, waiting frames and the steps of the keyframes over the time of a realtime run."""
    figure, (lag, waiting, steps) = _panels(1.5, 3)
    x, y = _xy(frames, "done", "lag")
    _line(lag, *binned(x, y), "lag", color=ORANGE)
    _label(lag, "", "lag [s]")
    _line(waiting, *binned(*_xy(frames, "done", "waiting")), "waiting", color=BLUE)
    _label(waiting, "", "frames waiting")
    keyframes = [note for note in frames if note.is_keyframe]
    _line(steps, *binned(*_xy(keyframes, "done", "steps")), "keyframe-steps", color=GREEN)
    _label(steps, "time [s]", "steps a keyframe")
    for axes in (lag, waiting, steps):
        axes.set_ylim(bottom=0)
    return figure


@_drawn
def steps(notes: Sequence[StepNote]) -> Figure:
    """Plot the smoothed PSNR over the steps of refinement or offline optimisation, and the Gaussians if recorded."""
    counted = notes[0].gaussians is not None
    figure, axes = _panels(2.1, 2 if counted else 1)
    _line(axes[-1], *binned(*_xy(notes, "step", "psnr"), 100), "step-psnr", color=ORANGE)
    _label(axes[-1], "step", "PSNR of the views\nbeing optimised [dB]")
    if counted:
        _gaussians(axes[0], *binned(*_xy(notes, "step", "gaussians")), "step-gaussians")
    return figure


@_drawn
def trajectory(
    plan: Plan,
    before: Sequence[NDArray[np.float64]],
    after: Sequence[NDArray[np.float64]],
    keyframes: Sequence[int],
    floor: tuple[NDArray[np.float64], NDArray[np.float64]],
    truth: NDArray[np.float64] | None = None,
) -> Figure:
    """Plot the camera centres from above, over the map.

    Args:
        plan: The axes of the view.
        before: The tracker's T_camera_world (4, 4).
        after: T_camera_world (4, 4) after mapping.
        keyframes: Positions of the keyframes among the frames.
        floor: Page positions (N, 2) and colours (N, 3) of Gaussians.
        truth: (M, 3) true camera centres in the map's world, or None.
    """
    ways = {"after": plan.on_page(camera_centres(after)), "before": plan.on_page(camera_centres(before))}
    if truth is not None:
        ways["truth"] = plan.on_page(truth)
    around = np.concatenate(list(ways.values()))
    figure, (whole, close) = _panels(4.4, columns=2)
    if len(floor[0]):
        size = float(np.clip(30_000 / len(floor[0]), 1.0, 14.0))
        whole.scatter(*floor[0].T, s=size, c=floor[1], alpha=0.6, linewidths=0, rasterized=True)
    for axes, name, (low, high) in (
        (whole, "in the map", _extent(around, floor[0])),
        (close, "closer", _extent(around, around[:0])),
    ):
        if "truth" in ways:
            x, y = ways["truth"].T
            _line(axes, x, y, "way-truth", color=GREEN, lw=2.8, alpha=0.6, label="ground truth")
        x, y = ways["before"].T
        _line(axes, x, y, "way-before", color=GREY, ls="--", label="tracker")
        x, y = ways["after"].T
        _line(axes, x, y, "way-after", color=ORANGE, label="after mapping")
        if len(keyframes):
            axes.plot(*ways["after"][list(keyframes)].T, ".", ms=3.5, color=ORANGE, label="keyframes")
        axes.plot(*ways["after"][0], "o", ms=7, mfc="none", color="black", label="first frame")
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_aspect("equal")
        axes.set_title(name, fontsize=9)
        _label(axes, "scene units", "")
    figure.legend(*close.get_legend_handles_labels(), ncols=5, loc="outside upper center")
    return figure


@_drawn
def pose_changes(
    tracked: Sequence[NDArray[np.float64]],
    versions: Mapping[str, Sequence[NDArray[np.float64]]],
    scene_depth: float,
) -> Figure:
    """Plot how far each version moved and turned the cameras away from the tracker's poses.

    Args:
        tracked: The tracker's T_camera_world (4, 4).
        versions: T_camera_world (4, 4) of every frame, by version.
        scene_depth: The scene's depth [scene units].
    """
    figure, (above, below) = _panels(1.7, 2)
    x = np.arange(len(tracked), dtype=float)
    for stage, poses in versions.items():
        shifts, turns = shifts_and_turns(tracked, poses)
        _line(above, x, 100 * shifts / scene_depth, f"shift-{stage}", color=OF_STAGE[stage], label=stage)
        _line(below, x, turns, f"turn-{stage}", color=OF_STAGE[stage])
    _label(above, "", "shift\n[% of scene depth]")
    _label(below, "frame", "turn [degrees]")
    for axes in (above, below):
        axes.set_ylim(bottom=0)
    above.legend(ncols=3, loc="lower right", bbox_to_anchor=(1, 1))
    return figure


def _xy(notes: Sequence[FrameNote | StepNote | FrameScore], x: str, y: str) -> tuple[NDArray, NDArray]:
    """Return two attributes of the notes as arrays. None becomes NaN."""
    return np.array([getattr(note, x) for note in notes], float), np.array([getattr(note, y) for note in notes], float)


def _gaussians(axes: Axes, x: NDArray, count: NDArray, name: str) -> None:
    _line(axes, x, count, name, color=BLUE)
    axes.set_ylim(bottom=0)
    axes.yaxis.set_major_formatter("{x:,.0f}")
    _label(axes, "", "Gaussians")


def _line(axes: Axes, x: NDArray, y: NDArray, name: str, **style: Any) -> None:
    """Plot a curve with an id in the SVG. A single value becomes a dot; values that are not finite become gaps."""
    finite = np.isfinite(y)
    marker: dict[str, Any] = {"marker": "o", "ms": 4} if finite.sum() < 2 else {}
    axes.plot(x, np.where(finite, y, np.nan), gid=name, **marker, **style)


def _label(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)


def _extent(ways: NDArray[np.float64], floor: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners of the plotted area, which has a fixed aspect: all paths, and the floor without outliers."""
    low, high = ways.min(axis=0), ways.max(axis=0)
    if len(floor):
        low = np.minimum(low, np.quantile(floor, 0.02, axis=0))
        high = np.maximum(high, np.quantile(floor, 0.98, axis=0))
    size = np.maximum(1.1 * (high - low), 1e-3)
    size = np.maximum(size, [PANEL * size[1], size[0] / PANEL])
    return (low + high - size) / 2, (low + high + size) / 2

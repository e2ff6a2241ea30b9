"""The report's drawings, each as SVG text, and the numbers and the view from above behind them."""

from __future__ import annotations

import functools
import io
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ParamSpec

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import camera_centres
from fields.map.gaussians import SH_C0
from modp_ti.outputs.evaluation import FrameScore
from modp_ti.outputs.report.record import FrameNote, StepNote

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Maximum number of points of a curve. More would not be visible.
MOST_POINTS = 400
# Maximum number of Gaussians drawn, and their minimum opacity.
MOST_SHOWN = 20_000
LEAST_OPACITY = 0.5
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
# A page in dark colours shows the drawings in them, too: black becomes light, white disappears.
DARK = """@media screen and (prefers-color-scheme: dark) { text { fill: #ddd !important }
[style*="fill: #ffffff"] { fill: none !important } [style*="stroke: #e4e4e4"] { stroke: #34373c !important }
[style*="stroke: #000000"] { stroke: #bbb !important } [style*="stroke: #666666"] { stroke: #aaa !important }
[style*="stroke: #0072b2"] { stroke: #4aa8e0 !important } [style*="fill: #0072b2"] { fill: #4aa8e0 !important } }"""


def frame_rate(frames: Sequence[FrameNote], window: int) -> NDArray[np.float64]:
    """Return frames per second (N,) over the `window` frames that end at each frame.

    The first `window - 1` values are NaN. If there are fewer frames than `window`, the last value is the rate over all
    of them.
    """
    done = np.array([0.0, *(note.done for note in frames)])
    window = min(window, len(frames))
    rate = np.full(len(frames), np.nan)
    rate[window - 1 :] = window / np.maximum(done[window:] - done[:-window], 1e-9)
    return rate


def binned(
    x: NDArray[np.float64], y: NDArray[np.float64], points: int = MOST_POINTS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Average neighbouring finite values into at most `points` bins, and return the means of x and y."""
    finite = np.isfinite(y)
    x, y = x[finite], y[finite]
    parts = max(1, min(points, len(x)))
    return (
        np.array([part.mean() for part in np.array_split(x, parts) if len(part)]),
        np.array([part.mean() for part in np.array_split(y, parts) if len(part)]),
    )


def shifts_and_turns(
    before: Sequence[NDArray[np.float64]], after: Sequence[NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far each camera moved [scene units] and turned [degrees].

    Args:
        before: T_camera_world (4, 4) of every frame.
        after: The same frames' poses after the change.
    """
    a, b = np.asarray(before), np.asarray(after)
    R_a, R_b = a[:, :3, :3], b[:, :3, :3]
    # |R - I|^2 = 8 sin^2(angle / 2): exact for small angles, where the arc cosine of the trace is not.
    difference = np.linalg.norm(R_b @ R_a.transpose(0, 2, 1) - np.eye(3), axis=(1, 2))
    turns = 2 * np.arcsin(np.minimum(difference / np.sqrt(8.0), 1.0))
    return np.linalg.norm(camera_centres(b) - camera_centres(a), axis=1), np.degrees(turns)


@dataclass(frozen=True)
class Plan:
    """Axes of a view from above.

    Attributes:
        right: (3,) unit vector to the right of the page.
        ahead: (3,) unit vector to the top of the page.
        up: (3,) unit vector towards the reader.
    """

    right: NDArray[np.float64]
    ahead: NDArray[np.float64]
    up: NDArray[np.float64]

    def on_page(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project world points (N, 3) to the page (N, 2)."""
        return points @ np.stack([self.right, self.ahead], axis=1)


def plan_of(poses: Sequence[NDArray[np.float64]]) -> Plan:
    """Return the plan for cameras at T_camera_world (4, 4).

    Up is the cameras' mean up direction. The longest extent of the path is horizontal, and the first camera faces the
    top of the page.
    """
    T = np.asarray(poses)
    rotations = T[:, :3, :3]
    centres = camera_centres(T)
    up = _unit(-rotations[:, 1].mean(axis=0), -rotations[0, 1])
    flat = centres - centres.mean(axis=0)
    flat = flat - np.outer(flat @ up, up)
    axes = np.linalg.svd(flat, full_matrices=True)[2]
    anyhow = np.cross(np.eye(3)[np.argmin(np.abs(up))], up)
    right = axes[0] - (axes[0] @ up) * up
    right = _unit(right if np.abs(flat).max() > 1e-9 else rotations[0, 0] - (rotations[0, 0] @ up) * up, anyhow)
    ahead = np.cross(up, right)
    if rotations[0, 2] @ ahead < 0:
        right, ahead = -right, -ahead
    return Plan(right, ahead, up)


def floor_plan(
    plan: Plan, gaussians: Mapping[str, NDArray], centres: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return page positions (N, 2) and colours (N, 3) of the opaque Gaussians below the cameras, lowest first.

    Args:
        plan: The axes of the view.
        gaussians: Arrays by name, as from `GaussianField.to_numpy`.
        centres: (M, 3) camera centres. Gaussians above their median height are left out.
    """
    position = np.asarray(gaussians["position"], dtype=np.float64)
    opaque = np.asarray(gaussians["opacity_logit"]).ravel() > np.log(LEAST_OPACITY / (1 - LEAST_OPACITY))
    height = position @ plan.up
    shown = np.flatnonzero(opaque & (height <= np.median(centres @ plan.up)) & np.isfinite(position).all(axis=1))
    shown = shown[:: max(1, -(-len(shown) // MOST_SHOWN))]
    shown = shown[np.argsort(height[shown], kind="stable")]
    colour = 0.5 + SH_C0 * np.asarray(gaussians["sh"], dtype=np.float64)[shown, 0]
    return plan.on_page(position[shown]), np.clip(colour, 0.0, 1.0)


def _unit(v: NDArray[np.float64], otherwise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normalise `v`, or `otherwise` if `v` is close to zero."""
    v = v if np.linalg.norm(v) > 1e-6 else otherwise
    return v / np.linalg.norm(v)


Arguments = ParamSpec("Arguments")


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
        return file.getvalue().replace("</style>", f"{DARK}</style>", 1)

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
    from matplotlib.ticker import LogLocator, NullFormatter

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
    axes[1].yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes[1].yaxis.set_major_formatter("{x:g}")
    axes[1].yaxis.set_minor_formatter(NullFormatter())
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
    figure, (whole, close) = _panels(4.6, columns=2)
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
        # The last version is often close to the one before, which stays visible as a broad line below it.
        style = {"color": OF_STAGE[stage]} | ({} if stage == list(versions)[-1] else {"lw": 4.0})
        _line(above, x, 100 * shifts / scene_depth, f"shift-{stage}", label=stage, **style)
        _line(below, x, turns, f"turn-{stage}", **style)
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

"""The report's drawings, each as SVG text, and the numbers and the view from above behind them."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import camera_centres
from fields.map.gaussians import SH_C0
from modp_ti.outputs.evaluation import FrameScore
from modp_ti.outputs.report.record import FrameNote, StepNote
from pipelines.whole.coverage import THIN

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


def svg(draw: Callable[..., Figure], *values: Any) -> str:
    """Return what a function of this module draws as SVG text."""
    # Imported here so that a run does not wait for matplotlib at its start. The message about building its font cache,
    # once per machine, does not concern the user.
    logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)
    import matplotlib.style

    file = io.StringIO()
    with matplotlib.style.context(["default", STYLE]):  # ignore the user's matplotlib settings
        about = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        draw(*values).savefig(file, format="svg", dpi=130, metadata=about)
    return file.getvalue().replace("</style>", f"{DARK}</style>", 1)


# ---- curves ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Curve:
    """A curve with an id in the SVG and a style of matplotlib. A single value becomes a dot; NaN becomes a gap."""

    name: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    style: Mapping[str, Any] = field(default_factory=dict)

    def plot(self, axes: Axes) -> None:
        finite = np.isfinite(self.y)
        marker: dict[str, Any] = {"marker": "o", "ms": 4} if finite.sum() < 2 else {}
        axes.plot(self.x, np.where(finite, self.y, np.nan), gid=self.name, **{**marker, **self.style})


@dataclass(frozen=True)
class Panel:
    """Curves with one axis.

    Attributes:
        label: What the axis shows.
        curves: The curves.
        form: Format of the axis's numbers: "count" from 0 with thousands, "log", "from 0", or "" for any.
    """

    label: str
    curves: Sequence[Curve]
    form: str = ""


def panels(height: float, x_label: str, rows: Sequence[Panel]) -> Figure:
    """Draw panels of this height [inches] above each other, which share their x axis."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = Figure(figsize=(WIDTH, len(rows) * height))
    for axes, panel in zip(figure.subplots(len(rows), 1, sharex=True, squeeze=False).ravel(), rows, strict=True):
        for curve in panel.curves:
            curve.plot(axes)
        axes.set_ylabel(panel.label)
        axes.set_xlabel(x_label if panel is rows[-1] else "")
        if panel.form == "log":
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter(NullFormatter())
        elif panel.form:
            axes.set_ylim(bottom=0)
        if panel.form == "count":
            axes.yaxis.set_major_formatter("{x:,.0f}")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(ncols=4, loc="lower right", bbox_to_anchor=(1, 1))
    return figure


def psnr_of_frames(scores: Sequence[FrameScore], frames: Sequence[FrameNote] = ()) -> Figure:
    """Plot the PSNR of every frame in each version of the map, with held-out frames as dots.

    Args:
        scores: Scores of all frames in all versions.
        frames: The run's frames; the PSNR of keyframes soon after they were mapped is drawn below the versions'.
    """
    curves = []
    if mapped := [note for note in frames if note.mapped_psnr is not None]:
        style = {"color": GREY, "lw": 1.0, "label": "keyframes, just mapped"}
        curves.append(Curve("psnr-mapped", *_xy(mapped, "index", "mapped_psnr"), style))
    for stage in dict.fromkeys(score.stage for score in scores):
        of = [score for score in scores if score.stage == stage]
        style = {"color": OF_STAGE[stage], "label": stage}
        curves.append(Curve(f"psnr-{stage}", *_xy(of, "index", "psnr"), style))
        if held_out := [score for score in of if score.held_out]:
            dots = style | {"ls": "", "marker": "o", "ms": 3.2, "label": f"{stage}, held out"}
            curves.append(Curve(f"held-out-{stage}", *_xy(held_out, "index", "psnr"), dots))
    return panels(3.0, "frame", [Panel("PSNR [dB]", curves)])


def growth(frames: Sequence[FrameNote]) -> Figure:
    """Plot the number of Gaussians, frames per second and the PSNR of the optimised views over the frames."""
    window = max(5, len(frames) // 20)
    x, count = _xy(frames, "index", "gaussians")
    gaussians = [Curve("gaussians", x, count, {"color": BLUE})]
    keyframes = [note for note in frames if note.is_keyframe]
    if len(keyframes) < len(frames):
        style = {"color": BLUE, "ls": "", "marker": ".", "ms": 4, "label": "keyframes"}
        gaussians.append(Curve("keyframes", *_xy(keyframes, "index", "gaussians"), style))
    rate = Curve("frame-rate", x, frame_rate(frames, window), {"color": GREEN})
    rows = [
        Panel("Gaussians", gaussians, "count"),
        # Frames that are not keyframes are a hundred times faster.
        Panel(f"frames per second\n(last {window})", [rate], "log"),
    ]
    if mapped := [note for note in frames if note.psnr is not None]:
        views = Curve("view-psnr", *_xy(mapped, "index", "psnr"), {"color": ORANGE})
        rows.append(Panel("PSNR of the views\nbeing optimised [dB]", [views]))
    return panels(1.75, "frame", rows)


def pace(frames: Sequence[FrameNote]) -> Figure:
    """Plot lag, waiting frames and the steps of the keyframes over the time of a realtime run."""
    keyframes = [note for note in frames if note.is_keyframe]
    rows = [
        Panel(label, [Curve(name, *binned(*_xy(notes, "done", value)), {"color": colour})], "from 0")
        for label, name, notes, value, colour in (
            ("lag [s]", "lag", frames, "lag", ORANGE),
            ("frames waiting", "waiting", frames, "waiting", BLUE),
            ("steps a keyframe", "keyframe-steps", keyframes, "steps", GREEN),
        )
    ]
    return panels(1.5, "time [s]", rows)


def steps(notes: Sequence[StepNote]) -> Figure:
    """Plot the smoothed PSNR over the steps of refinement or offline optimisation, and the Gaussians if recorded."""
    psnr = Curve("step-psnr", *binned(*_xy(notes, "step", "psnr"), 100), {"color": ORANGE})
    rows = [Panel("PSNR of the views\nbeing optimised [dB]", [psnr])]
    if notes[0].gaussians is not None:
        count = Curve("step-gaussians", *binned(*_xy(notes, "step", "gaussians")), {"color": BLUE})
        rows.insert(0, Panel("Gaussians", [count], "count"))
    return panels(2.1, "step", rows)


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
    x, shifted, turned = np.arange(len(tracked), dtype=float), [], []
    for stage, poses in versions.items():
        shifts, turns = shifts_and_turns(tracked, poses)
        # The last version is often close to the one before, which stays visible as a broad line below it.
        style = {"color": OF_STAGE[stage]} | ({} if stage == list(versions)[-1] else {"lw": 4.0})
        shifted.append(Curve(f"shift-{stage}", x, 100 * shifts / scene_depth, {**style, "label": stage}))
        turned.append(Curve(f"turn-{stage}", x, turns, style))
    rows = [Panel("shift\n[% of scene depth]", shifted, "from 0"), Panel("turn [degrees]", turned, "from 0")]
    return panels(1.7, "frame", rows)


def places(error: NDArray[np.float64], detail: NDArray[np.float64], aspect: float) -> Figure:
    """Draw where in the picture the map is wrong.

    Args:
        error: Root mean square error (R, C) in [0, 1], of the cells of a grid over the picture.
        detail: Explained detail (R, C), at most 1.
        aspect: Width over height of the picture.
    """
    from matplotlib.figure import Figure

    shown = (("root mean square error [% of black to white]", 100 * error, "inferno", None),)
    shown = (*shown, ("detail", detail, "viridis", 1.0))
    figure = Figure(figsize=(WIDTH, min(0.45 * WIDTH / aspect, WIDTH) + 0.3))
    for axes, (title, values, colours, most) in zip(figure.subplots(1, 2), shown, strict=True):
        drawn = axes.imshow(values, cmap=colours, vmin=0.0, vmax=most, extent=(0.0, aspect, 0.0, 1.0))
        axes.set(xticks=[], yticks=[], title=title)
        axes.spines[:].set_visible(False)
        axes.title.set_fontsize(9)
        figure.colorbar(drawn, ax=axes, shrink=0.9)
    return figure


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
    bins = np.array_split(np.stack([x[finite], y[finite]]), max(1, min(points, int(finite.sum()))), axis=1)
    means = np.array([part.mean(axis=1) for part in bins if part.size]).reshape(-1, 2)
    return means[:, 0], means[:, 1]


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


def _xy(notes: Sequence[FrameNote | StepNote | FrameScore], x: str, y: str) -> tuple[NDArray, NDArray]:
    """Return two attributes of the notes as arrays. None becomes NaN."""
    return np.array([getattr(note, x) for note in notes], float), np.array([getattr(note, y) for note in notes], float)


# ---- the view from above -----------------------------------------------------------------------------------------


def plan_of(poses: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the axes of a view from above, for cameras at T_camera_world (4, 4).

    Up is the cameras' mean up direction. The longest extent of the path is horizontal, and the first camera faces the
    top of the page.

    Returns:
        (3, 3) unit vectors in its rows: to the right of the page, to its top, and towards the reader.
    """
    T = np.asarray(poses)
    rotations = T[:, :3, :3]
    centres = camera_centres(T)
    up = _unit(-rotations[:, 1].mean(axis=0), -rotations[0, 1])
    flat = centres - centres.mean(axis=0)
    flat = flat - np.outer(flat @ up, up)
    along = np.linalg.svd(flat, full_matrices=True)[2][0] if np.abs(flat).max() > 1e-9 else rotations[0, 0]
    least: NDArray[np.float64] = np.eye(3)[np.argmin(np.abs(up))]
    right = _unit(along - (along @ up) * up, np.cross(least, up))
    ahead = np.cross(up, right)
    return np.stack([right, ahead, up]) * ([[-1], [-1], [1]] if rotations[0, 2] @ ahead < 0 else 1)


def floor_plan(
    plan: NDArray[np.float64], gaussians: Mapping[str, NDArray], centres: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions (N, 3) along the plan's axes and colours (N, 3) of the opaque Gaussians below the cameras.

    The lowest come first.

    Args:
        plan: The axes of the view, see `plan_of`.
        gaussians: Arrays by name, as from `GaussianField.to_numpy`.
        centres: (M, 3) camera centres. Gaussians above their median height are left out.
    """
    position = np.asarray(gaussians["position"], dtype=np.float64) @ plan.T
    opaque = np.asarray(gaussians["opacity_logit"]).ravel() > np.log(LEAST_OPACITY / (1 - LEAST_OPACITY))
    below = position[:, 2] <= np.median(centres @ plan[2])
    shown = np.flatnonzero(opaque & below & np.isfinite(position).all(axis=1))
    shown = shown[:: max(1, -(-len(shown) // MOST_SHOWN))]
    shown = shown[np.argsort(position[shown, 2], kind="stable")]
    colour = 0.5 + SH_C0 * np.asarray(gaussians["sh"], dtype=np.float64)[shown, 0]
    return position[shown], np.clip(colour, 0.0, 1.0)


def trajectory(
    plan: NDArray[np.float64],
    before: Sequence[NDArray[np.float64]],
    after: Sequence[NDArray[np.float64]],
    keyframes: Sequence[int],
    floor: tuple[NDArray[np.float64], NDArray[np.float64]],
    truth: NDArray[np.float64] | None = None,
) -> Figure:
    """Plot the camera centres from above, over the map.

    Args:
        plan: The axes of the view, see `plan_of`.
        before: The tracker's T_camera_world (4, 4).
        after: T_camera_world (4, 4) after mapping.
        keyframes: Positions of the keyframes among the frames.
        floor: Positions (N, 3) and colours (N, 3) of Gaussians, see `floor_plan`.
        truth: (M, 3) true camera centres in the map's world, or None.
    """
    from matplotlib.figure import Figure

    ways = {
        "way-before": (camera_centres(before), {"color": GREY, "ls": "--", "label": "tracker"}),
        "way-after": (camera_centres(after), {"color": ORANGE, "label": "after mapping"}),
    }
    if truth is not None:
        style = {"color": GREEN, "lw": 2.8, "alpha": 0.6, "label": "ground truth"}
        ways = {"way-truth": (truth, style), **ways}
    curves = [Curve(name, centres @ plan[0], centres @ plan[1], style) for name, (centres, style) in ways.items()]
    around = np.concatenate([np.stack([curve.x, curve.y], axis=1) for curve in curves])
    x, y = curves[-1].x, curves[-1].y
    figure = Figure(figsize=(WIDTH, 4.6))
    whole, close = figure.subplots(1, 2)
    if len(floor[0]):
        size = float(np.clip(30_000 / len(floor[0]), 1.0, 14.0))
        whole.scatter(*floor[0].T[:2], s=size, c=floor[1], alpha=0.6, linewidths=0, rasterized=True)
    for axes, name, (low, high) in (
        (whole, "in the map", _extent(around, floor[0][:, :2])),
        (close, "closer", _extent(around, around[:0])),
    ):
        for curve in curves:
            curve.plot(axes)
        if len(keyframes):
            axes.plot(x[list(keyframes)], y[list(keyframes)], ".", ms=3.5, color=ORANGE, label="keyframes")
        axes.plot(x[0], y[0], "o", ms=7, mfc="none", color="black", label="first frame")
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="scene units")
        axes.set_title(name, fontsize=9)
    figure.legend(*close.get_legend_handles_labels(), ncols=5, loc="outside upper center")
    return figure


def coverage(
    way: NDArray[np.float64],
    floor: NDArray[np.float64],
    angles: NDArray[np.float64],
    film: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
) -> Figure:
    """Plot from above how wide an angle the places of a map are seen from.

    Args:
        way: Camera centres (M, 2) on the page.
        floor: Page positions (N, 2) of Gaussians.
        angles: Their angles (N,) [degrees], NaN where no camera sees them.
        film: Page positions (2,) of where to stand and of what to film next, or None.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, 4.6))
    axes = figure.subplots()
    size = float(np.clip(60_000 / max(len(floor), 1), 1.0, 14.0))
    style = {"cmap": "turbo_r", "vmin": 0.0, "vmax": 2 * THIN, "alpha": 0.7, "linewidths": 0, "rasterized": True}
    known = np.isfinite(angles)
    drawn = axes.scatter(*floor[known].T, s=size, c=angles[known], **style)
    axes.plot(*way.T, color=GREY, label="camera")
    if film is not None:
        arrow = {"arrowstyle": "-|>", "lw": 2.0, "color": "black"}
        axes.annotate("", xy=tuple(film[1]), xytext=tuple(film[0]), arrowprops=arrow)
    low, high = _extent(way if film is None else np.concatenate([way, np.stack(film)]), floor)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="scene units")
    figure.colorbar(drawn, ax=axes, shrink=0.9, label="widest angle between two cameras [degrees]")
    return figure


def _unit(v: NDArray[np.float64], otherwise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normalise `v`, or `otherwise` if `v` is close to zero."""
    v = v if np.linalg.norm(v) > 1e-6 else otherwise
    return v / np.linalg.norm(v)


def _extent(ways: NDArray[np.float64], floor: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners of the plotted area, which has a fixed aspect: all paths, and the floor without outliers."""
    low, high = ways.min(axis=0), ways.max(axis=0)
    if len(floor):
        low = np.minimum(low, np.quantile(floor, 0.02, axis=0))
        high = np.maximum(high, np.quantile(floor, 0.98, axis=0))
    size = np.maximum(1.1 * (high - low), 1e-3)
    size = np.maximum(size, [PANEL * size[1], size[0] / PANEL])
    return (low + high - size) / 2, (low + high + size) / 2

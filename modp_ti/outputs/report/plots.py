"""The report's curves and pictures, each as SVG text, and the numbers behind them."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import camera_centres
from modp_ti.outputs.evaluation import FrameScore
from modp_ti.outputs.report.record import FrameNote, StepNote

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Maximum number of points of a curve. More would not be visible.
MOST_POINTS = 400
WIDTH = 9.2  # inches; the page scales it
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

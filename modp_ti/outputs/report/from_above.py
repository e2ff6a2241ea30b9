"""The report's drawings from above: the way of the cameras over the map, and how wide an angle it was filmed from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import camera_centres
from fields.map.gaussians import SH_C0
from modp_ti.outputs.report.plots import GREEN, GREY, ORANGE, WIDTH, Curve
from pipelines.whole.coverage import THIN

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Maximum number of Gaussians drawn, and their minimum opacity.
MOST_SHOWN = 20_000
LEAST_OPACITY = 0.5
PANEL = 1.15  # width over height of a drawing


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

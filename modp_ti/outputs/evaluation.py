"""Evaluation: the map against the frames, as the paper reports it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.se3 import inverse_se3
from fields.map.gaussians import GaussianField
from modp_ti.outputs.lpips import Lpips
from pipelines.optimise.losses import PhotometricLoss
from pipelines.render.renderer import Renderer

__all__ = [
    "EvaluatedMap",
    "FrameScore",
    "MapVersion",
    "absolute_trajectory_error",
    "evaluate",
    "score_frame",
    "summary",
    "trajectory_errors",
    "umeyama",
]

# Frames in memory at a time, to load each version of the map once for all of them.
EVALUATED_TOGETHER = 32


class EvaluatedMap(Protocol):
    """What evaluation needs of a mapper: where a map is loaded, and how it is seen and compared."""

    gaussians: GaussianField
    renderer: Renderer
    loss: PhotometricLoss

    @property
    def near(self) -> float:
        """Depth [scene units] below which nothing is drawn."""


@dataclass(frozen=True)
class MapVersion:
    """A map at one time: Gaussians by name as `GaussianField.to_numpy`, T_camera_world and exposure of every frame.

    view_renders: views that were rendered and differentiated to make it.
    """

    gaussians: dict[str, NDArray]
    trajectory: list[NDArray[np.float64]]
    exposures: list[NDArray[np.float64] | None]
    view_renders: int


@dataclass(frozen=True)
class FrameScore:
    """Scores of one frame in one version of the map; lpips is None where it has no weights.

    stage: "online", "refined" or "offline". index: position among the frames. psnr: [dB].
    """

    index: int
    name: str
    held_out: bool
    stage: str
    psnr: float
    ssim: float
    lpips: float | None


def summary(scores: Sequence[FrameScore]) -> dict[str, float | int | None]:
    """Means over the frames, as they stand in metrics.json; null where there is nothing to take the mean of."""

    def mean(values: list[float | None], digits: int) -> float | None:
        return None if not values or None in values else round(float(np.mean(values)), digits)

    return {
        "psnr": mean([score.psnr for score in scores], 4),
        "ssim": mean([score.ssim for score in scores], 5),
        "lpips": mean([score.lpips for score in scores], 5),
        "count": len(scores),
    }


def score_frame(
    renderer: Renderer,
    loss: PhotometricLoss,
    frame: TrackedFrame,
    T_camera_world: NDArray[np.float64],
    near: float,
    stage: str,
    lpips: Lpips | None = None,
    exposure: NDArray[np.float64] | None = None,
) -> tuple[FrameScore, NDArray[np.float32]]:
    """Scores and render (H, W, 3) of `frame` seen from T_camera_world (4, 4) in the renderer's map.

    The render is developed with the frame's exposure (3, 4) and vignette, and clipped to [0, 1]. Masked pixels do not
    count and are shown as in the frame.
    """
    rgba = frame.rgba
    renderer.forward(frame.camera, T_camera_world, near)
    renderer.develop(exposure, frame.vignette)
    renderer.images.clip_colour()
    renderer.images.set_reference(rgba)
    values = loss.forward()
    render = renderer.images.colour_to_numpy()
    distance = None if lpips is None else lpips(render, rgba[..., :3] / np.float32(255.0))
    return FrameScore(frame.index, frame.name, frame.held_out, stage, values.psnr, values.ssim, distance), render


def evaluate(
    mapper: EvaluatedMap,
    frames: Iterable[TrackedFrame],
    versions: Mapping[str, MapVersion],
    lpips: Lpips | None,
    rendered: Callable[[str, TrackedFrame, NDArray[np.float32]], None],
) -> list[FrameScore]:
    """Scores of every frame in every version of the map by name, version by version.

    rendered: called with the version's name, the frame and its render (H, W, 3). The last version stays in the mapper.
    """
    scores: dict[str, list[FrameScore]] = {name: [] for name in versions}
    frames = iter(frames)
    while batch := list(islice(frames, EVALUATED_TOGETHER)):
        for name, version in versions.items():
            mapper.gaussians.load(version.gaussians)
            for frame in batch:
                T, exposure = version.trajectory[frame.index], version.exposures[frame.index]
                score, render = score_frame(mapper.renderer, mapper.loss, frame, T, mapper.near, name, lpips, exposure)
                scores[name].append(score)
                rendered(name, frame, render)
    return [score for of in scores.values() for score in of]


def umeyama(
    source: NDArray[np.float64], target: NDArray[np.float64], with_scale: bool = True
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Scale s, rotation R (3, 3), translation t (3,) of least |s R source + t - target|^2 [Umeyama 1991]."""
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    a, b = source - mean_source, target - mean_target
    U, singular, Vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ np.diag(sign) @ Vt
    s = float((singular * sign).sum() / max((a * a).sum(), 1e-300)) if with_scale else 1.0
    return s, R, mean_target - s * R @ mean_source


def absolute_trajectory_error(
    estimate: list[NDArray[np.float64]], truth: list[NDArray[np.float64]], with_scale: bool = True
) -> float:
    """RMSE of camera centres after alignment, in the units of `truth`; both lists hold T_camera_world (4, 4)."""
    source = np.array([inverse_se3(T)[:3, 3] for T in estimate])
    target = np.array([inverse_se3(T)[:3, 3] for T in truth])
    s, R, t = umeyama(source, target, with_scale)
    return float(np.sqrt(((s * source @ R.T + t - target) ** 2).sum(axis=1).mean()))


def trajectory_errors(
    tracked: list[NDArray[np.float64]], refined: list[NDArray[np.float64]], truth: list[NDArray[np.float64]]
) -> dict[str, float | None]:
    """ATE of the refined poses (aligned by a similarity, and rigidly) and of the tracked ones; None without truth."""
    cases = {"ate_rmse": (refined, True), "ate_rmse_rigid": (refined, False), "ate_rmse_tracked": (tracked, True)}
    return {
        name: round(absolute_trajectory_error(poses, truth, with_scale), 6) if len(truth) else None
        for name, (poses, with_scale) in cases.items()
    }

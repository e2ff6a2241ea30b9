"""Evaluation of a map against its frames, with the metrics of the paper."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.se3 import camera_centres
from fields.map.keyframe import Keyframe
from modp_ti.outputs.lpips import Lpips
from pipelines.companions.transients import (
    CoarseView,
    coarse_view,
    compared,
    moving,
    neighbours,
    place_of,
    soft_mask,
    without,
)
from pipelines.pipeline import Pipeline
from pipelines.render.formulas import LossValues
from pipelines.render.renderer import RenderedView
from pipelines.whole.hierarchy import ShownMap

SIGMA = 1.0  # blur that the finest band lies above [px]
# Batch size. Each version of the map is loaded once per batch, whose frames are all held in memory.
EVALUATED_TOGETHER = 32


def explained_detail(
    render: NDArray[np.floating], image: NDArray[np.floating], valid: NDArray[np.bool_]
) -> float | None:
    """Return 1 - |finest band of image - render|^2 / |finest band of image|^2.

    The finest band is an image minus itself blurred with a sigma of one pixel. PSNR hardly depends on it: a render that
    is as sharp as the image scores 1, a render blurred by much more than a pixel 0, and noise or misplaced edges less.

    Args:
        render: Rendered colour (H, W, 3) in [0, 1].
        image: Observed colour (H, W, 3) in [0, 1].
        valid: Pixels that count (H, W). The others neither count nor enter the blur.

    Returns:
        The share, None if the image has no detail.
    """
    detail = finest_band(image, valid)
    whole = float(np.square(detail, dtype=np.float64).sum())
    lost = float(np.square(detail - finest_band(render, valid), dtype=np.float64).sum())
    return None if whole == 0.0 else 1.0 - lost / whole


def finest_band(picture: NDArray[np.floating], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return a picture (H, W, 3) minus itself blurred, see `explained_detail`; 0 where it is not valid (H, W)."""
    picture = np.asarray(picture, dtype=np.float32)
    if valid.all():
        return picture - _blurred(picture)
    counted = picture.copy()
    counted[~valid] = 0.0
    weight = valid.astype(np.float32)
    share = weight / np.maximum(_blurred(weight), np.float32(1e-6))
    blurred = _blurred(counted)
    blurred *= cv2.merge([share] * 3)
    counted -= blurred
    return counted


def _blurred(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), SIGMA, borderType=cv2.BORDER_REFLECT_101), dtype=np.float32)


@dataclass(frozen=True)
class MapVersion:
    """A copy of a map at one point of a run.

    Attributes:
        gaussians: Arrays by name, as from `GaussianField.to_numpy`.
        trajectory: T_camera_world (4, 4) of every frame.
        exposures: Exposure (3, 4) of every frame, or None.
        view_renders: Number of views that were rendered and differentiated to make the map.
    """

    gaussians: dict[str, NDArray]
    trajectory: list[NDArray[np.float64]]
    exposures: list[NDArray[np.float64] | None]
    view_renders: int


@dataclass(frozen=True)
class StillScore:
    """Scores of a frame without what moves in it.

    Attributes:
        psnr: PSNR [dB].
        ssim: SSIM.
        moving: Share of the image that was left out.
    """

    psnr: float
    ssim: float
    moving: float


class StillScorer:
    """Scores frames in one version of a map without what moves.

    A frame's mask is found as those of keyframes are, by comparing the frame with its render and asking the keyframes
    around it. The map need not have been optimised on the frame.

    Args:
        pipeline: Holds the version of the map whenever `score` is called.
        version: The version.
        shown: Loads it.
    """

    def __init__(self, pipeline: Pipeline, version: MapVersion, shown: ShownMap) -> None:
        self._pipeline = pipeline
        self._version = version
        self._views = list(pipeline.keyframes)
        self._coarse: list[CoarseView] = []
        for place, view in enumerate(self._views):
            T, exposure = version.trajectory[view.index], version.exposures[view.index]
            if place == 0 or not shown.fits:
                shown.show(view.camera, T)
            coarse = compared(pipeline.renderer, view, T, exposure, pipeline.near)
            self._coarse.append(without(coarse, view.transient))

    def score(self, frame: TrackedFrame, render: RenderedView) -> StillScore:
        """Score the frame that was rendered last.

        Args:
            frame: The frame. The renderer's images hold its render.
            render: The same render, with the colour developed and clipped.
        """
        coarse = coarse_view(render, frame.rgba, frame.camera, self._version.trajectory[frame.index])
        around = neighbours(place_of(self._views, frame.index), len(self._views))
        mask = soft_mask(*moving(coarse, [self._coarse[i] for i in around], kept=False))
        rgba = frame.rgba.copy()
        if mask is not None:
            size = (frame.camera.width, frame.camera.height)
            rgba[np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR)) < 255] = 0
        values = self._pipeline.loss.forward(rgba)
        moving_share = 1.0 - (rgba[..., 3] > 0).sum() / max((frame.rgba[..., 3] > 0).sum(), 1)
        return StillScore(values.psnr, values.ssim, float(moving_share))


@dataclass(frozen=True)
class FrameScore:
    """Scores of one frame in one version of the map.

    Attributes:
        index: Position among the frames.
        name: The frame's name.
        held_out: Whether the frame was kept from the map.
        stage: "online", "refined" or "offline".
        psnr: PSNR [dB].
        ssim: SSIM.
        lpips: LPIPS, None if its weights are not available.
        detail: Share of the image's finest band that the render explains, see `explained_detail`. None if the image
            has no detail.
        still: Scores without what moves; None if `mapping.transients` is off. They are not in `scores.csv`.
    """

    index: int
    name: str
    held_out: bool
    stage: str
    psnr: float
    ssim: float
    lpips: float | None
    detail: float | None = None
    still: StillScore | None = None


def summary(scores: Sequence[FrameScore]) -> dict[str, float | int | None]:
    """Return the mean scores over the frames, as in metrics.json. A mean is None if there is nothing to average.

    If what moves was masked, `psnr_still` and `ssim_still` are the means without it, and `moving` is its share of the
    images.
    """
    means: dict[str, float | int | None] = {}
    for name, digits in (("psnr", 4), ("ssim", 5), ("lpips", 5), ("detail", 5)):
        known = [value for score in scores if (value := getattr(score, name)) is not None]
        means[name] = round(float(np.mean(known)), digits) if known and len(known) == len(scores) else None
    still = [score.still for score in scores if score.still is not None]
    if still:
        means["psnr_still"] = round(float(np.mean([s.psnr for s in still])), 4)
        means["ssim_still"] = round(float(np.mean([s.ssim for s in still])), 5)
        means["moving"] = round(float(np.mean([s.moving for s in still])), 5)
    return means | {"count": len(scores)}


def score_frame(
    pipeline: Pipeline,
    frame: TrackedFrame,
    T_camera_world: NDArray[np.float64],
    stage: str,
    lpips: Lpips | None = None,
    exposure: NDArray[np.float64] | None = None,
) -> tuple[FrameScore, RenderedView]:
    """Render a frame's view in the current map and score it.

    The render is developed with the frame's exposure and vignette and clipped to [0, 1]. Masked pixels do not count,
    and have the frame's colours in the returned render.

    Args:
        pipeline: Holds the map.
        frame: The frame to compare with.
        T_camera_world: (4, 4) pose to render from.
        stage: Name of the map's version, stored in the score.
        lpips: The LPIPS network, None to leave it out.
        exposure: (3, 4) affine colour transform of the frame, None for the identity.

    Returns:
        The score, and the render.
    """
    rgba = frame.rgba
    values = _compare(pipeline, frame, T_camera_world, exposure)
    images = pipeline.renderer.images
    render = RenderedView(images.colour_to_numpy(), images.depth_to_numpy(), images.opacity_to_numpy())
    image = np.asarray(rgba[..., :3] / np.float32(255.0), dtype=np.float32)
    distance = None if lpips is None else lpips(render.colour, image)
    detail = explained_detail(render.colour, image, rgba[..., 3] > 0)
    score = FrameScore(frame.index, frame.name, frame.held_out, stage, values.psnr, values.ssim, distance, detail)
    return score, render


def keyframe_psnr(pipeline: Pipeline, view: Keyframe) -> float:
    """Return the PSNR [dB] of a keyframe in the current map, computed as `score_frame` does."""
    return _compare(pipeline, view, view.T_camera_world, view.exposure).psnr


def _compare(
    pipeline: Pipeline,
    frame: TrackedFrame | Keyframe,
    T_camera_world: NDArray[np.float64],
    exposure: NDArray[np.float64] | None,
) -> LossValues:
    """Render a frame's view, develop and clip it, and compare it with the frame's image."""
    renderer = pipeline.renderer
    renderer.forward(frame.camera, T_camera_world, pipeline.near)
    renderer.develop(exposure, frame.vignette)
    renderer.images.clip_colour()
    return pipeline.loss.forward(frame.rgba)


def evaluate(
    pipeline: Pipeline,
    frames: Iterable[TrackedFrame],
    versions: Mapping[str, MapVersion],
    lpips: Lpips | None,
    rendered: Callable[[str, TrackedFrame, RenderedView], None],
) -> list[FrameScore]:
    """Score every frame in every version of the map.

    Args:
        pipeline: Receives the maps in turn. The last version stays loaded.
        frames: All frames.
        versions: Map versions by name.
        lpips: The LPIPS network, None to leave it out.
        rendered: Called with the version's name, the frame and its render, with the colour developed and clipped.

    Returns:
        The scores, ordered by version.
    """
    scores: dict[str, list[FrameScore]] = {name: [] for name in versions}
    shown = {name: ShownMap(pipeline.gaussians, of.gaussians) for name, of in versions.items()}
    still: dict[str, StillScorer] = {}
    frames = iter(frames)
    while batch := list(islice(frames, EVALUATED_TOGETHER)):
        for name, version in versions.items():
            for place, frame in enumerate(batch):
                T, exposure = version.trajectory[frame.index], version.exposures[frame.index]
                if pipeline.transients is not None and name not in still:
                    still[name] = StillScorer(pipeline, version, shown[name])
                if place == 0 or not shown[name].fits:
                    shown[name].show(frame.camera, T)
                score, render = score_frame(pipeline, frame, T, name, lpips, exposure)
                if name in still:
                    score = replace(score, still=still[name].score(frame, render))
                scores[name].append(score)
                rendered(name, frame, render)
    return [score for of in scores.values() for score in of]


def umeyama(
    source: NDArray[np.float64],
    target: NDArray[np.float64],
    with_scale: bool = True,
    weight: NDArray[np.float64] | None = None,
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Find the similarity that minimises |s R source + t - target|^2 [Umeyama 1991].

    Args:
        source: (N, 3) points.
        target: (N, 3) corresponding points.
        with_scale: Whether to estimate the scale; 1 otherwise.
        weight: (N,) weights of the points; None for equal ones.

    Returns:
        Scale s, rotation R (3, 3) and translation t (3,).
    """
    mean_source, mean_target = (np.average(points, axis=0, weights=weight) for points in (source, target))
    w = np.ones((len(source), 1)) if weight is None else np.sqrt(weight)[:, None]
    a, b = w * (source - mean_source), w * (target - mean_target)
    U, singular, Vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ np.diag(sign) @ Vt
    s = float((singular * sign).sum() / max((a * a).sum(), 1e-300)) if with_scale else 1.0
    return s, R, mean_target - s * R @ mean_source


def absolute_trajectory_error(
    estimate: list[NDArray[np.float64]], truth: list[NDArray[np.float64]], with_scale: bool = True
) -> float:
    """Return the RMSE of the camera centres after alignment, in the units of `truth`.

    Args:
        estimate: T_camera_world (4, 4) of every frame.
        truth: Ground-truth T_camera_world (4, 4) of every frame, NaN for frames without one, which do not count.
        with_scale: Whether to align by a similarity; by a rigid motion otherwise.
    """
    source, target = camera_centres(estimate), camera_centres(truth)
    known = np.isfinite(target).all(axis=1)
    source, target = source[known], target[known]
    s, R, t = umeyama(source, target, with_scale)
    return float(np.sqrt(((s * source @ R.T + t - target) ** 2).sum(axis=1).mean()))


def trajectory_errors(
    tracked: list[NDArray[np.float64]], refined: list[NDArray[np.float64]], truth: list[NDArray[np.float64]]
) -> dict[str, float | None]:
    """Return the ATE of the refined poses (aligned by a similarity, and rigidly) and of the tracked poses.

    All three are None without ground truth.
    """
    cases = {"ate_rmse": (refined, True), "ate_rmse_rigid": (refined, False), "ate_rmse_tracked": (tracked, True)}
    return {
        name: round(absolute_trajectory_error(poses, truth, with_scale), 6) if len(truth) else None
        for name, (poses, with_scale) in cases.items()
    }

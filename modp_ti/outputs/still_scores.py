"""Scores of the still parts of frames: what moves is left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
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
from pipelines.render.renderer import RenderedView
from pipelines.whole.shown_map import ShownMap

__all__ = ["StillScore", "StillScorer"]


class Poses(Protocol):
    """Poses and exposures of all frames in a version of the map, see `MapVersion`."""

    @property
    def trajectory(self) -> Sequence[NDArray[np.float64]]: ...

    @property
    def exposures(self) -> Sequence[NDArray[np.float64] | None]: ...


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
        version: Its poses and exposures.
        shown: Loads it.
    """

    def __init__(self, pipeline: Pipeline, version: Poses, shown: ShownMap) -> None:
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

    def score(self, frame: TrackedFrame, colour: NDArray[np.float32]) -> StillScore:
        """Score the frame that was rendered last.

        Args:
            frame: The frame. The renderer's images hold its render, with the colour developed and clipped.
            colour: The colour (H, W, 3) of that render.
        """
        images = self._pipeline.renderer.images
        render = RenderedView(colour, images.depth_to_numpy(), images.opacity_to_numpy())
        coarse = coarse_view(render, frame.rgba, frame.camera, self._version.trajectory[frame.index])
        around = neighbours(place_of(self._views, frame.index), len(self._views))
        mask = soft_mask(*moving(coarse, [self._coarse[i] for i in around], kept=False))
        rgba = frame.rgba.copy()
        if mask is not None:
            size = (frame.camera.width, frame.camera.height)
            rgba[np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR)) < 255] = 0
        images.set_reference(rgba)
        values = self._pipeline.loss.forward()
        moving_share = 1.0 - (rgba[..., 3] > 0).sum() / max((frame.rgba[..., 3] > 0).sum(), 1)
        return StillScore(values.psnr, values.ssim, float(moving_share))

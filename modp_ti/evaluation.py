"""Evaluation: the map against the frames, as the paper reports it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fields.se3 import inverse_se3
from fields.tracked_frame import TrackedFrame
from pipelines.losses import PhotometricLoss
from pipelines.rendering import Renderer

__all__ = ["Scores", "absolute_trajectory_error", "score_frame", "umeyama"]


@dataclass
class Scores:
    """PSNR [dB] and SSIM, a list entry a frame."""

    psnr: list[float] = field(default_factory=list)
    ssim: list[float] = field(default_factory=list)

    def add(self, psnr: float, ssim: float) -> None:
        self.psnr.append(psnr)
        self.ssim.append(ssim)

    def summary(self) -> dict[str, float | int | None]:
        """Means over the frames, as they stand in metrics.json. lpips is null: its weights are not shipped."""
        count = len(self.psnr)
        return {
            "psnr": round(float(np.mean(self.psnr)), 4) if count else None,
            "ssim": round(float(np.mean(self.ssim)), 5) if count else None,
            "lpips": None,
            "count": count,
        }


def score_frame(
    renderer: Renderer,
    loss: PhotometricLoss,
    frame: TrackedFrame,
    T_camera_world: NDArray[np.float64],
    near: float,
    exposure: NDArray[np.float64] | None = None,
) -> tuple[float, float, NDArray[np.float32]]:
    """(PSNR, SSIM, render (H, W, 3)) of `frame` seen from T_camera_world (4, 4), developed with exposure (3, 4).

    The render is clipped to [0, 1]. Masked pixels do not count and are shown as in the frame.
    """
    renderer.forward(frame.camera, T_camera_world, near)
    renderer.develop(exposure, frame.vignette)
    renderer.images.clip_colour()
    renderer.images.set_reference(frame.rgba())
    values = loss.forward()
    return values.psnr, values.ssim, renderer.images.colour_to_numpy()


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

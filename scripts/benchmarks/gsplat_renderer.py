"""Measures the same scene with `gsplat.rasterization`, if gsplat and a GPU are available.

Written against gsplat 1.5's documentation. It has not been run, as no GPU was available.
"""

from __future__ import annotations

import importlib.util

import numpy as np
import torch

from benchmarks.scene import Size, arrays, camera_of
from fields.map.gaussians import SH_C0

__all__ = ["measure_gsplat", "why_no_gsplat"]


def why_no_gsplat() -> str | None:
    """Return why gsplat cannot be measured here, or None if it can."""
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed"
    return None if torch.cuda.is_available() else "gsplat needs a CUDA device, and PyTorch finds none"


def measure_gsplat(size: Size, repeats: int) -> dict[str, float]:
    """Return the time of rendering one view [ms], `forward`, and `forward and backward` to all Gaussian parameters.

    Activations are included, as in this project's projection. Opacities are compensated as here.
    """
    import gsplat

    scene = arrays(size)
    camera = camera_of(size.width, size.height)

    def tensor(values: np.ndarray, trained: bool = True) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float32, device="cuda", requires_grad=trained)

    means, log_scales, quats = tensor(scene["position"]), tensor(scene["log_scale"]), tensor(scene["quaternion"])
    logits, colours = tensor(scene["opacity_logit"]), tensor(scene["sh"][:, 0])
    K = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    viewmats, Ks = tensor(np.eye(4)[None], False), tensor(np.array([K]), False)
    weights = torch.rand(1, size.height, size.width, 3, device="cuda")

    def forward() -> torch.Tensor:
        render, _, _ = gsplat.rasterization(
            means=means,
            quats=quats,
            scales=torch.exp(log_scales),
            opacities=torch.sigmoid(logits),
            colors=torch.clamp_min(0.5 + SH_C0 * colours, 0.0),
            viewmats=viewmats,
            Ks=Ks,
            width=size.width,
            height=size.height,
            rasterize_mode="antialiased",
        )
        return render

    def both() -> None:
        (forward() * weights).sum().backward()

    return {"forward": _milliseconds(forward, repeats), "forward and backward": _milliseconds(both, repeats)}


def _milliseconds(call, repeats: int) -> float:
    times = []
    for _ in range(repeats + 1):
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        call()
        end.record()
        torch.cuda.synchronize()
        times.append(start.elapsed_time(end))
    return float(np.median(times[1:]))

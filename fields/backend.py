"""Starting Taichi: the one place where the compute device is chosen."""

from __future__ import annotations

import taichi as ti

__all__ = ["initialise"]


def initialise(device: str = "cpu", threads: int | None = None, seed: int = 0) -> str:
    """Start Taichi on `device` and return the backend that was taken ("cpu" or "cuda").

    device: "cpu", "cuda" (fails where there is none) or "auto" (CUDA where it works). Kernels are kept in
    Taichi's offline cache, so that only the first process on a machine compiles them.

    Raises RuntimeError where "cuda" was asked for and does not start.
    """
    options = {
        "offline_cache": True,
        "log_level": ti.ERROR,
        "random_seed": seed,
        "default_fp": ti.f32,
        "default_ip": ti.i32,
    }
    if threads is not None:
        options["cpu_max_num_threads"] = threads
    if device in ("cuda", "auto") and ti._lib.core.with_cuda():
        ti.init(arch=ti.cuda, **options)
        if ti.lang.impl.current_cfg().arch == ti.cuda:
            return "cuda"
    if device == "cuda":
        raise RuntimeError("device: cuda was asked for, and no CUDA device starts here; use device: cpu or auto")
    ti.init(arch=ti.cpu, **options)
    return "cpu"

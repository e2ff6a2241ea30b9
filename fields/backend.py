"""Starting Taichi: the one place where the compute device is chosen."""

from __future__ import annotations

import contextlib
import ctypes
import io

import taichi as ti
import torch

__all__ = ["initialise", "refuse_too_many_fields"]

# Arrays of Taichi's runtime have this many entries, and it does not look.
MAX_SNODES = 1024


def initialise(device: str = "cpu", threads: int | None = None, seed: int = 0) -> str:
    """Start Taichi on `device` and return the backend that was taken ("cpu" or "cuda").

    device: "cpu", "cuda" (fails where there is none) or "auto" (CUDA where it works). Kernels are kept in
    Taichi's offline cache, so that only the first process on a machine compiles them.

    PyTorch is held to one thread: its problems here are small, and its waiting threads take the cores from Taichi's
    (a depth estimate took 1.9 s instead of 0.05 s).

    Raises RuntimeError where "cuda" was asked for and does not start.
    """
    options = {"offline_cache": True, "log_level": ti.ERROR, "random_seed": seed, "default_fp": ti.f32}
    torch.set_num_threads(1)
    if threads is not None:
        options["cpu_max_num_threads"] = threads
    if device in ("cuda", "auto") and _has_cuda_driver():
        _start(ti.cuda, options)
        if ti.lang.impl.current_cfg().arch == ti.cuda:
            return "cuda"
    if device == "cuda":
        raise RuntimeError("device: cuda was asked for, but no CUDA device starts here; use device: cpu or auto")
    _start(ti.cpu, options)
    return "cpu"


def _has_cuda_driver() -> bool:
    # Asked of the system and not of Taichi, which complains on the terminal where there is none.
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


def _start(arch: object, options: dict) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        ti.init(arch=arch, **options)


def refuse_too_many_fields(last_placed: object) -> None:
    """Raise RuntimeError where this scalar field, the last one placed, is beyond what a Taichi process holds."""
    if last_placed.snode.ptr.id >= MAX_SNODES:
        raise RuntimeError(
            "more maps and renderers than one Taichi process holds; call initialise() before making another, "
            "which frees those made so far"
        )

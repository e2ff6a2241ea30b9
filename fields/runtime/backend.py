"""Starting Taichi: the one place where the compute device is chosen, and with it the form of storage and kernels."""

from __future__ import annotations

import contextlib
import ctypes
import io

import numpy as np
import taichi as ti
import torch

from fields.runtime.kernel_sources import answer_quickly
from fields.runtime.workers import pin_workers, threads_of_process

__all__ = [
    "describe",
    "growing",
    "initialise",
    "on_gpu",
    "program",
    "refuse_too_many_fields",
    "torch_device",
    "without_waiting",
]

# Arrays of Taichi's runtime have this many entries, and it does not look.
MAX_SNODES = 1024
# Taichi's own pool on a CUDA device, for the nodes of sparse fields: the occupancy voxels alone [GB]. Dense fields and
# PyTorch take what they need of the rest.
SPARSE_POOL = 1.0


def initialise(device: str = "cpu", threads: int | None = None, seed: int = 0) -> str:
    """Start Taichi on `device` and return the backend that was taken ("cpu", "cuda" or "vulkan").

    device: "cpu", "cuda" (fails where there is none) or "auto" (CUDA where it works). Kernels are kept in
    Taichi's offline cache, so that only the first process on a machine compiles them. "vulkan" is for the tests, which
    run the GPU's kernels on a software driver where there is no CUDA; it has no sparse fields, hence no voxels.

    PyTorch is held to one thread: its problems here are small, and its waiting threads take the cores from Taichi's
    (a depth estimate took 1.9 s instead of 0.05 s).

    Raises RuntimeError where "cuda" or "vulkan" was asked for and does not start.
    """
    options = {"offline_cache": True, "log_level": ti.ERROR, "random_seed": seed, "default_fp": ti.f32}
    torch.set_num_threads(1)
    answer_quickly()
    if threads is not None:
        options["cpu_max_num_threads"] = threads
    if device in ("cuda", "auto") and _has_cuda_driver() and torch.cuda.is_available():
        _start(ti.cuda, options | {"device_memory_GB": SPARSE_POOL})
        if ti.lang.impl.current_cfg().arch == ti.cuda:
            return "cuda"
    if device == "cuda":
        # PyTorch sorts on the device, in the same memory: a build without CUDA cannot.
        missing = "no CUDA device starts here" if torch.version.cuda else "this PyTorch is built without CUDA"
        raise RuntimeError(f"device: cuda was asked for, but {missing}; use device: cpu or auto")
    if device == "vulkan":
        _start(ti.vulkan, options)
        if ti.lang.impl.current_cfg().arch == ti.vulkan:
            return "vulkan"
        raise RuntimeError("no Vulkan driver starts here")
    before = threads_of_process()
    _start(ti.cpu, options)
    pin_workers(before, ti.lang.impl.current_cfg().cpu_max_num_threads)
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


def describe(backend: str) -> str:
    """What a run says of the backend that it took: the device's name, or why a GPU was left alone."""
    if backend == "cuda":
        return f"CUDA ({torch.cuda.get_device_name()})"
    if backend == "cpu" and _has_cuda_driver() and not torch.cuda.is_available():
        return "CPU (there is a CUDA driver, but this PyTorch cannot use it)"
    return backend.upper() if backend == "cpu" else backend.capitalize()


def program() -> object:
    """What owns all fields at present; `initialise` puts another in its place, and fields made before are gone.

    Raises RuntimeError before the first.
    """
    running = ti.lang.impl.get_runtime().prog
    if running is None:
        raise RuntimeError('Taichi does not run yet: call modp_ti.initialise("cpu") (or "cuda", "auto") first')
    return running


def on_gpu() -> bool:
    """Whether Taichi runs on a GPU, or on what stands in for one: dense storage, and the kernels of `render/gpu`."""
    return ti.lang.impl.current_cfg().arch in (ti.cuda, ti.vulkan)


def torch_device() -> torch.device:
    """Where tensors must lie to be read and written by kernels without a copy."""
    return torch.device("cuda" if ti.lang.impl.current_cfg().arch == ti.cuda else "cpu")


def without_waiting(array: np.ndarray) -> np.ndarray | torch.Tensor:
    """A small array as an argument of a kernel that only reads it, and that the host does not wait for.

    Taichi itself copies NumPy's arrays to a CUDA device and back, and waits for both; passing vectors by value takes it
    eight microseconds a number.
    """
    if ti.lang.impl.current_cfg().arch != ti.cuda:
        return array
    return torch.from_numpy(array).pin_memory().to("cuda", non_blocking=True)


def growing(builder: ti.FieldsBuilder, blocks: int) -> ti.SNode:
    """A node of `blocks` blocks of entries, for dense children.

    Sparse on the CPU, where memory follows what is written. Dense on a GPU: its allocator would run inside the kernels
    of a step, and Vulkan has none.
    """
    return builder.dense(ti.i, blocks) if on_gpu() else builder.pointer(ti.i, blocks)


def refuse_too_many_fields(last_placed: object) -> None:
    """Raise RuntimeError where this scalar field, the last one placed, is beyond what a Taichi process holds."""
    if last_placed.snode.ptr.id >= MAX_SNODES:
        raise RuntimeError(
            "more maps and renderers than one Taichi process holds; call initialise() before making another, "
            "which frees those made so far"
        )

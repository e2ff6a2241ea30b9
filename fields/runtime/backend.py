"""Start of the engine and choice of the compute device, which determines the storage layout and the kernels."""

from __future__ import annotations

import contextlib
import ctypes
import io

import numpy as np
import torch

from fields.runtime.engine import configuration, engine, running_program, ti
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

answer_quickly()  # at import, since most of the time that it saves goes into the definitions of kernels

MAX_SNODES = engine().max_snodes
# The engine's own memory pool on a CUDA device, for the nodes of sparse fields [GB]. Only the voxels use it; dense
# fields and PyTorch use the remaining memory.
SPARSE_POOL = 1.0


def initialise(device: str = "cpu", threads: int | None = None, seed: int = 0) -> str:
    """Start the engine on a device.

    Kernels are stored in the engine's offline cache, so that only the first process on a machine compiles them. PyTorch
    is limited to one thread: its problems here are small, and its waiting threads take the cores from the engine's (a
    depth estimate took 1.9 s instead of 0.05 s).

    Args:
        device: "cpu", "cuda", or "auto" for CUDA if it is available and the CPU otherwise. "vulkan" is for the tests,
            which run the GPU kernels on a software driver; it has no sparse fields and hence no voxels.
        threads: Number of CPU threads; None for all.
        seed: Seed of the engine's random numbers.

    Returns:
        Name of the backend in use, which is "cpu", "cuda" or "vulkan".

    Raises:
        RuntimeError: If "cuda" or "vulkan" was requested and does not start.

    Example:
        backend = modp_ti.initialise("auto", seed=1)
    """
    options = {"offline_cache": True, "log_level": ti.ERROR, "random_seed": seed, "default_fp": ti.f32}
    torch.set_num_threads(1)
    if threads is not None:
        options["cpu_max_num_threads"] = threads
    if device in ("cuda", "auto") and _has_cuda_driver() and torch.cuda.is_available():
        _start(ti.cuda, options | {"device_memory_GB": SPARSE_POOL})
        if configuration().arch == ti.cuda:
            return "cuda"
    if device == "cuda":
        # PyTorch sorts on the device, in the same memory: a build without CUDA cannot.
        missing = "no CUDA device starts here" if torch.version.cuda else "this PyTorch is built without CUDA"
        raise RuntimeError(f"device: cuda was asked for, but {missing}; use device: cpu or auto")
    if device == "vulkan":
        _start(ti.vulkan, options)
        if configuration().arch == ti.vulkan:
            return "vulkan"
        raise RuntimeError("no Vulkan driver starts here")
    before = threads_of_process()
    _start(ti.cpu, options)
    pin_workers(before, configuration().cpu_max_num_threads)
    return "cpu"


def _has_cuda_driver() -> bool:
    # Load the driver directly, since the engine prints a warning if there is none.
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


def _start(arch: object, options: dict) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        ti.init(arch=arch, **options)


def describe(backend: str) -> str:
    """Describe a backend for the log of a run: the device's name, or why an existing GPU is not used.

    Args:
        backend: Result of `initialise`.
    """
    if backend == "cuda":
        return f"CUDA ({torch.cuda.get_device_name()})"
    if backend == "cpu" and _has_cuda_driver() and not torch.cuda.is_available():
        return "CPU (there is a CUDA driver, but this PyTorch cannot use it)"
    return backend.upper() if backend == "cpu" else backend.capitalize()


def program() -> object:
    """Return the engine's program that owns all current fields.

    `initialise` replaces the program and invalidates all fields created before.

    Raises:
        RuntimeError: If `initialise` has not been called.
    """
    running = running_program()
    if running is None:
        raise RuntimeError(
            f'{engine().title} does not run yet: call modp_ti.initialise("cpu") (or "cuda", "auto") first'
        )
    return running


def on_gpu() -> bool:
    """Whether dense storage and the kernels of `render/gpu` are in use: on CUDA and Vulkan."""
    return configuration().arch in (ti.cuda, ti.vulkan)


def torch_device() -> torch.device:
    """Device on which kernels can read and write tensors without a copy."""
    return torch.device("cuda" if configuration().arch == ti.cuda else "cpu")


def without_waiting(array: np.ndarray) -> np.ndarray | torch.Tensor:
    """Prepare a small array as a read-only kernel argument, so that the launch does not wait for the device.

    On CUDA, the engine copies NumPy arrays to the device and back and waits for both. Passing the values as scalars
    takes eight microseconds each.

    Args:
        array: The array.

    Returns:
        A tensor on a CUDA device; otherwise the array itself.
    """
    if configuration().arch != ti.cuda:
        return array
    return torch.from_numpy(array).pin_memory().to("cuda", non_blocking=True)


def growing(builder: ti.FieldsBuilder, blocks: int) -> ti.SNode:
    """Create an SNode of `blocks` blocks, for dense children.

    On the CPU, the node is sparse, so that memory follows what is written. On a GPU it is dense, because the allocator
    of sparse nodes would run inside the kernels of a step, and Vulkan has none.
    """
    return builder.dense(ti.i, blocks) if on_gpu() else builder.pointer(ti.i, blocks)


def refuse_too_many_fields(last_placed: ti.ScalarField | ti.MatrixField) -> None:
    """Check that the fields placed so far fit into the engine's runtime.

    Args:
        last_placed: The scalar field that was placed last.

    Raises:
        RuntimeError: If there are more SNodes than the engine supports in a process.
    """
    if MAX_SNODES is not None and last_placed.snode.ptr.id >= MAX_SNODES:
        raise RuntimeError(
            f"more maps and renderers than one {engine().title} process holds; call initialise() before making "
            "another, which frees those made so far"
        )

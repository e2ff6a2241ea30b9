"""Start of the engine and choice of the compute device, which determines the storage layout and the kernels."""

from __future__ import annotations

import contextlib
import ctypes
import io
import os
import sys
from collections.abc import Sequence

import numpy as np
import torch

from fields.runtime.engine import configuration, engine, forget_arrays, lock, running_program, start, ti
from fields.runtime.gpus import VulkanDevice, choose, computes_rightly, vulkan_devices
from fields.runtime.kernel_sources import answer_quickly
from fields.runtime.process import pin_workers, threads_of_process

answer_quickly()  # at import, since most of the time that it saves goes into the definitions of kernels

MAX_SNODES = engine().max_snodes
MAX_SPARSE = engine().max_sparse
# The engine's own memory pool on a CUDA device, for the nodes of sparse fields [GB]. Only the voxels use it; dense
# fields and PyTorch use the remaining memory.
SPARSE_POOL = 1.0
_sparse: list[ti.SNode] = []  # the sparse SNodes since the engine was started
_started: tuple[str, int | None, int] = "cpu", None, 0  # arguments of the last `initialise`


def initialise(device: str = "cpu", threads: int | None = None, seed: int = 0) -> str:
    """Start the engine on a device.

    Kernels are stored in the engine's offline cache, so that only the first process on a machine compiles them. PyTorch
    is limited to one thread: its problems here are small, and its waiting threads take the cores from the engine's (a
    depth estimate took 1.9 s instead of 0.05 s).

    Maps, renderers and voxels made before cannot be used any more: they raise RuntimeError.

    Args:
        device: "cpu", "cuda", "vulkan", "metal", or "auto" for the first that is available of CUDA, a GPU through Metal
            (on macOS) or Vulkan (elsewhere), and the CPU. "vulkan" takes a software driver where there is no GPU,
            "auto" never does. With several Vulkan devices, TI_VISIBLE_DEVICE (with Quadrants, QD_VISIBLE_DEVICE)
            chooses one by its number.
        threads: Number of CPU threads; None for all.
        seed: Seed of the engine's random numbers.

    Returns:
        Name of the backend in use, which is "cpu", "cuda", "vulkan" or "metal".

    Raises:
        RuntimeError: If a GPU was requested and does not start.

    Example:
        backend = modp_ti.initialise("auto", seed=1)
    """
    global _started
    with lock:
        backend = _initialise(device, threads, seed)
        _started = device, threads, seed
        return backend


def restart() -> None:
    """Start the engine as it was started before, which frees all fields."""
    initialise(*_started)


def _initialise(device: str, threads: int | None, seed: int) -> str:
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
    for gpu in ("metal", "vulkan"):
        if device == gpu or (device == "auto" and _has_gpu(gpu)):
            missing = _start_on(gpu, options)
            if missing is None:
                return gpu
            if device == gpu:
                raise RuntimeError(f"device: {gpu} was asked for, but {missing}; use device: cpu or auto")
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


def _vulkan_device() -> VulkanDevice | None:
    return choose(vulkan_devices(), os.environ.get(engine().variable("visible_device")))


def _has_gpu(device: str) -> bool:
    """Whether there is a GPU for "metal" or "vulkan", and not just a software driver."""
    if device == "metal":
        return sys.platform == "darwin"
    chosen = _vulkan_device()
    return chosen is not None and chosen.is_gpu


def _start_on(device: str, options: dict) -> str | None:
    """Start the engine on "metal" or "vulkan". Return what is missing, or None if it has started there."""
    if device == "metal":
        if sys.platform != "darwin":
            return "only macOS has Metal"
        arch, name = ti.metal, "this machine's GPU"
    else:
        chosen = _vulkan_device()
        if chosen is None:
            return "no Vulkan driver starts here"
        if not chosen.has_int64:
            return f"{chosen.name} has no 64-bit integers"
        # The engine has to take the same device, whose features and kind were asked for and which `describe` names.
        os.environ[engine().variable("visible_device")] = str(chosen.index)
        arch, name = ti.vulkan, chosen.name
    _start(arch, options)
    if configuration().arch != arch:
        return f"{engine().title} does not start on {name}"
    return None if computes_rightly() else f"{name} does not compute what the kernels need"


def _start(arch: object, options: dict) -> None:
    _sparse.clear()
    forget_arrays()
    with contextlib.redirect_stdout(io.StringIO()):
        start(arch, arch == ti.cpu, **options)


def describe(backend: str) -> str:
    """Describe a result of `initialise` for the log of a run: the device, or why an existing GPU is not used."""
    if backend == "cuda":
        return f"CUDA ({torch.cuda.get_device_name()})"
    chosen = _vulkan_device() if backend == "vulkan" else None
    if chosen is not None:
        return f"Vulkan ({chosen.name})"
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


def running_backend() -> str | None:
    """Return the name of the backend in use as `initialise` does; None before it has been called."""
    return (
        None
        if running_program() is None
        else {ti.cuda: "cuda", ti.vulkan: "vulkan", ti.metal: "metal"}.get(configuration().arch, "cpu")
    )


def sparse_nodes() -> int:
    """Return the number of sparse SNodes that were made since the engine was started."""
    return len(_sparse)


def on_gpu() -> bool:
    """Whether dense storage and the kernels of `render/gpu` are in use: on CUDA, Vulkan and Metal."""
    return configuration().arch in (ti.cuda, ti.vulkan, ti.metal)


def has_sparse_fields() -> bool:
    """Whether the backend has sparse SNodes: the CPU and CUDA."""
    return configuration().arch not in (ti.vulkan, ti.metal)


def torch_device() -> torch.device:
    """Device on which kernels can read and write tensors without a copy."""
    return torch.device("cuda" if configuration().arch == ti.cuda else "cpu")


def without_waiting(array: np.ndarray) -> np.ndarray | torch.Tensor:
    """Return a small array as a read-only kernel argument, on CUDA as a tensor, whose launch waits for nothing.

    On CUDA, the engine copies NumPy arrays to the device and back and waits for both. The driver takes a copy of a
    small array at once, so that the array may change after this call; pinned memory would have to be kept until then.
    """
    if configuration().arch != ti.cuda:
        return array
    return torch.from_numpy(array).to("cuda", non_blocking=True)


def growing(builder: ti.FieldsBuilder, blocks: int) -> ti.SNode:
    """Create an SNode of `blocks` blocks, for dense children.

    On the CPU, the node is sparse, so that memory follows what is written. On a GPU it is dense, because the allocator
    of sparse nodes would run inside the kernels of a step, and Vulkan and Metal have none.
    """
    return builder.dense(ti.i, blocks) if on_gpu() else sparse(builder, ti.i, (blocks,))


def sparse(parent: ti.FieldsBuilder | ti.SNode, axes: list, shape: Sequence[int]) -> ti.SNode:
    """Create a sparse SNode below another one.

    Raises:
        RuntimeError: If there are more than the engine supports in a process.
    """
    if not on_gpu() and MAX_SPARSE is not None and len(_sparse) >= MAX_SPARSE:
        raise too_many()
    _sparse.append(parent.pointer(axes, shape))
    return _sparse[-1]


def place(fields: Sequence[ti.Field], blocks: ti.SNode, *shape: int) -> None:
    """Place fields of one access pattern as dense children of every block.

    On the CPU, the values of an element lie side by side, in one child. On a GPU, where neighbouring threads read
    neighbouring elements, each field has a child of its own: Adam on 500,000 Gaussians takes an H100 0.12 ms instead
    of 0.35.
    """
    for together in [[each] for each in fields] if on_gpu() else [fields]:
        child = blocks
        for axis, size in zip((ti.i, ti.j), shape, strict=False):
            child = child.dense(axis, size)
        child.place(*together)


def refuse_too_many_fields(last_placed: ti.ScalarField | ti.MatrixField) -> None:
    """Raise RuntimeError if the SNodes so far, up to the scalar field placed last, are too many for the engine."""
    if MAX_SNODES is not None and last_placed.snode.ptr.id >= MAX_SNODES:
        raise too_many()


def too_many() -> RuntimeError:
    """Return the error for a map, renderer or voxels for which there is no room."""
    return RuntimeError(
        f"more maps and renderers than one {engine().title} process holds; close one, or call initialise() before "
        "making another, which frees those made so far"
    )

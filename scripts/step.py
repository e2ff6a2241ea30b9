"""Measures one optimisation step on one view, and the machine that it runs on, on a made-up scene."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from fields.buffers.tiles import TILE_PIXELS, TILE_WIDTH
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.gaussians import GaussianField
from fields.map.keyframes import KeyframeStore
from fields.runtime.backend import initialise
from fields.runtime.compiled_kernel import CompiledKernel
from fields.runtime.engine import ti
from modp_ti.engine.results import peak_memory_mb
from pipelines.optimise.adam import LearningRates
from pipelines.optimise.map_optimiser import MapOptimiser
from pipelines.render.renderer import Renderer
from pipelines.settings import MappingSettings

STAGES = (
    "projection", "binning", "compositing", "loss", "compositing backward", "projection backward", "penalty", "Adam",
)  # fmt: skip
# Additions, multiplications and divisions; a fused multiply-add counts as two. Comparisons, selections and conversions
# are not counted. Per pixel-Gaussian pair in the inner loops of pipelines/render/cpu/compositing.py, including 14 for
# the exponential:
FORWARD_FLOPS = 34
BACKWARD_FLOPS = 54
# Per pixel and channel in pipelines/render/cpu/losses.py: five windows of 11 + 11 taps (including the products), SSIM
# and its derivatives, three windows of 11 + 11 taps, the gradient.
LOSS_FLOPS = 110 + 110 + 45 + 132 + 10
# Bytes per Gaussian that Adam updates: 14 float32 with gradient and two moments, and two counters, each read and
# written.
ADAM_BYTES = (14 * 4 + 2) * 4 * 2
# The machine's float32 throughput by PyTorch's BLAS, which comes within about ten percent of the peak; and its
# bandwidth by a = b + s c over arrays far larger than the caches, with two reads and one write an element. A CPU also
# fetches the lines that it overwrites, which is not counted.
MATRIX, TRIAD, BEST_OF = 2048, 32_000_000, 5


@dataclass(frozen=True)
class Size:
    """Size of a measurement.

    Attributes:
        width: Image width [px].
        height: Image height [px].
        gaussians: Number of Gaussians in view.
    """

    width: int
    height: int
    gaussians: int

    def __str__(self) -> str:
        return f"{self.width}x{self.height}, {self.gaussians:,} Gaussians"


# A phone's frame, a webcam's frame, and full detail.
SIZES = [Size(270, 480, 12_500), Size(640, 480, 100_000), Size(1280, 720, 500_000)]


def camera_of(width: int, height: int) -> PinholeCamera:
    """Return a camera with a horizontal field of view of about 61 degrees."""
    return PinholeCamera(0.85 * width, 0.85 * width, width / 2, height / 2, width, height)


def arrays(size: Size) -> dict[str, Any]:
    """Return random Gaussians at depths of 2 to 6 units by name, as `GaussianField.append` takes them."""
    rng = np.random.default_rng(0)
    camera, n = camera_of(size.width, size.height), size.gaussians
    depth = rng.uniform(2.0, 6.0, n)
    # Half the distance to the nearest neighbour: about one Gaussian per ten pixels at 480x270 and 12,500 Gaussians.
    sigma = 0.5 * np.sqrt(size.width * size.height / n) * depth / camera.focal
    return {
        "position": camera.unproject(rng.uniform((0, 0), (size.width, size.height), (n, 2)), depth),
        "log_scale": np.log(sigma)[:, None] + rng.normal(0.0, 0.5, (n, 3)),
        "quaternion": rng.normal(size=(n, 4)),
        "opacity_logit": rng.normal(0.0, 1.5, n),
        "sh": rng.normal(0.0, 0.5, (n, 1, 3)),
    }


def add_gaussians(gaussians: GaussianField, size: Size) -> None:
    """Append random Gaussians of this size."""
    gaussians.append(**arrays(size))


def noise_frame(width: int, height: int) -> TrackedFrame:
    """Return a noise image seen from the origin."""
    image = np.random.default_rng(1).random((height, width, 3), dtype=np.float32)
    return TrackedFrame(0, 0.0, "noise", image, camera_of(width, height), np.eye(4))


# ---- measurements ----------------------------------------------------------------------------------------------------


def seconds(call: Callable[[], object], wait: Callable[[], object] = ti.sync) -> float:
    """Return the time of a call [s], with the device synchronised by `wait` before and after it."""
    wait()
    start = time.perf_counter()
    call()
    wait()
    return time.perf_counter() - start


class _Operations(TorchDispatchMode):
    """Counts PyTorch's operations, except for those that only allocate or make views."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        self.count += not (func.is_view or "empty" in str(func))
        return func(*args, **(kwargs or {}))


def device_calls(call: Callable[[], object]) -> int:
    """Return the number of kernels and of PyTorch's operations that a call starts from the host."""
    launched: list[int] = []
    launch = CompiledKernel.__call__

    def counted(kernel: CompiledKernel, *arguments: Any) -> None:
        launched.append(1)
        launch(kernel, *arguments)

    with _Operations() as operations, patch.object(CompiledKernel, "__call__", counted):
        call()
    return len(launched) + operations.count


def milliseconds(
    stages: Mapping[str, Callable[[], object]], repeats: int, wait: Callable[[], object] = ti.sync
) -> dict[str, float]:
    """Return the median time of each stage [ms] over `repeats` passes through all stages, after one warm-up pass.

    The device is synchronised by `wait` after every stage. On a GPU, the sum therefore exceeds the time of an
    undisturbed pass.
    """
    passes = [{name: seconds(call, wait) for name, call in stages.items()} for _ in range(repeats + 1)]
    return {name: 1e3 * float(np.median([of[name] for of in passes[1:]])) for name in stages}


def measure_machine(device: str, threads: int) -> dict[str, float]:
    """Return gflops and gigabytes_per_second of float32, on `threads` CPU threads or on the GPU if it is used."""
    where = "cuda" if initialise(device, threads) == "cuda" else "cpu"
    wait = torch.cuda.synchronize if where == "cuda" else lambda: None
    torch.set_num_threads(threads)
    a, b = (torch.rand(MATRIX, MATRIX, device=where) for _ in range(2))
    product = torch.empty_like(a)
    x, y = (torch.rand(TRIAD, device=where) for _ in range(2))
    z = torch.empty_like(x)

    def best(call: Callable[[], object]) -> float:
        call()
        return min(seconds(call, wait) for _ in range(BEST_OF))

    return {
        "gflops": 2 * MATRIX**3 / best(lambda: torch.mm(a, b, out=product)) / 1e9,
        "gigabytes_per_second": 12 * TRIAD / best(lambda: torch.add(x, y, alpha=0.5, out=z)) / 1e9,
    }


def measure_step(device: str, threads: int, size: Size, repeats: int) -> dict[str, float]:
    """Measure the stages and the whole step on one view.

    Args:
        device: "cpu" or "cuda".
        threads: Number of CPU threads.
        size: Size of the scene.
        repeats: Number of timed calls.

    Returns:
        Time of each of STAGES and of a whole `step` [ms], counts of pairs, `peak_memory_mb` and `cores_had`; `host`,
            the time that the host takes to start a step [ms], and `calls`, the number of calls by which it does. The
            number of cores that worked on the steps is far fewer than `threads` if the machine is busy.
    """
    on_cpu = initialise(device, threads) == "cpu"
    settings = MappingSettings()
    gaussians = GaussianField()
    add_gaussians(gaussians, size)
    renderer = Renderer(gaussians, size.width, size.height)
    optimiser = MapOptimiser(gaussians, renderer, settings)
    store = KeyframeStore()
    view = store.append(noise_frame(size.width, size.height))
    # Zero learning rates: all the work of a step without a change of the scene.
    still = LearningRates(0.0, 0.0, 0.0, 0.0, 0.0)
    weights = settings.optimise

    def loss() -> None:
        optimiser.loss.forward(view.rgba)
        optimiser.loss.backward(weights.ssim_weight)

    optimiser.compare(view, store.scene_depth)
    calls = (
        renderer.projection.forward, renderer.binning.forward, renderer.compositing.forward, loss,
        renderer.compositing.backward, renderer.projection.backward,
        lambda: optimiser.aspect.backward(weights.aspect_weight, store.scene_depth), lambda: optimiser.adam.step(still),
    )  # fmt: skip
    pairs: Any = renderer.pairs  # whose form depends on the device
    figures: dict[str, Any] = milliseconds(dict(zip(STAGES, calls, strict=True)), repeats)
    figures["visible"] = renderer.projected.seen[None]  # on a GPU, `count` is only an upper bound
    # On a GPU, one thread per pixel visits whole tiles.
    figures["pairs visited"] = pairs.count * TILE_PIXELS
    if on_cpu:
        rows = pairs.rows_to_numpy()
        figures["pairs visited"] = int(((rows >> 16) - (rows & 0xFFFF)).sum()) * TILE_WIDTH
    wall, busy = time.perf_counter(), time.process_time()

    def step() -> None:
        optimiser.step(store, [0], still, pose_rate=0.0)

    figures |= milliseconds({"step": step}, repeats)
    figures["cores_had"] = (time.process_time() - busy) / (time.perf_counter() - wall)
    figures["host"] = milliseconds({"wait": ti.sync, "host": step}, repeats, wait=lambda: None)["host"]
    figures["calls"] = device_calls(step)
    figures["peak_memory_mb"] = peak_memory_mb()
    return figures

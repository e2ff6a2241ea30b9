"""Measures one optimisation step on one view: the time of every stage, the pixel-Gaussian pairs and the memory."""

from __future__ import annotations

import time

from benchmarks.scene import Size, add_gaussians, noise_frame
from benchmarks.timing import milliseconds, stage_milliseconds
from fields.buffers.tiles import TILE_PIXELS, TILE_WIDTH
from fields.map.gaussians import GaussianField
from fields.map.keyframes import KeyframeStore
from fields.runtime.backend import initialise
from modp_ti.engine.run_clock import peak_memory_mb
from pipelines.optimise.adam import LearningRates
from pipelines.optimise.map_optimiser import MapOptimiser
from pipelines.render.compositing_reference import ReferenceCompositing
from pipelines.render.renderer import Renderer
from pipelines.settings import MappingSettings

__all__ = ["ADAM_BYTES", "BACKWARD_FLOPS", "FORWARD_FLOPS", "LOSS_FLOPS", "STAGES", "measure_step"]

STAGES = (
    "projection", "binning", "compositing", "loss", "compositing backward", "projection backward", "penalty", "Adam",
)  # fmt: skip
# Additions, multiplications and divisions; a fused multiply-add counts as two. Comparisons, selections and conversions
# are not counted. Per pixel-Gaussian pair in the inner loops of pipelines/render/cpu/compositing.py, including 14 for
# the exponential:
FORWARD_FLOPS = 34
BACKWARD_FLOPS = 54
# Per pixel and channel in pipelines/optimise/losses.py: five windows of 11 + 11 taps (including the products), SSIM and
# its derivatives, three windows of 11 + 11 taps, the gradient.
LOSS_FLOPS = 110 + 110 + 45 + 132 + 10
# Bytes per Gaussian that Adam updates: 14 float32 with gradient and two moments, and two counters, each read and
# written.
ADAM_BYTES = (14 * 4 + 2) * 4 * 2


def measure_step(device: str, threads: int, size: Size, repeats: int, twin: bool = False) -> dict[str, float]:
    """Measure the stages and the whole step on one view.

    Args:
        device: "cpu" or "cuda".
        threads: Number of CPU threads.
        size: Size of the scene.
        repeats: Number of timed calls.
        twin: Also time the plain pixel-outer compositing that the tests compare with (CPU only).

    Returns:
        Time of each of STAGES and of a whole `step` [ms], counts of pairs, `peak_memory_mb` and `cores_had`. The last
            is the number of cores that worked on the steps, far fewer than `threads` if the machine is busy.
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
        renderer.images.set_reference(view.rgba)
        optimiser.loss.forward()
        optimiser.loss.backward(weights.ssim_weight)

    optimiser.compare(view, store.scene_depth)
    calls = (
        renderer.projection.forward, renderer.binning.forward, renderer.compositing.forward, loss,
        renderer.compositing.backward, renderer.projection.backward,
        lambda: optimiser.aspect.backward(weights.aspect_weight, store.scene_depth), lambda: optimiser.adam.step(still),
    )  # fmt: skip
    figures = stage_milliseconds(list(zip(STAGES, calls, strict=True)), repeats)
    figures["visible"] = renderer.projected.seen[None]  # on a GPU, `count` is only an upper bound
    figures["pairs of whole tiles"] = renderer.pairs.count * TILE_PIXELS
    if on_cpu:
        rows = renderer.pairs.rows_to_numpy()
        figures["pairs visited"] = int(((rows >> 16) - (rows & 0xFFFF)).sum()) * TILE_WIDTH
    else:
        # One thread per pixel visits whole tiles.
        figures["pairs visited"] = figures["pairs of whole tiles"]
    if on_cpu and twin:
        plain = ReferenceCompositing(renderer.view, renderer.projected, renderer.pairs, renderer.images)
        figures["twin"] = milliseconds(plain.forward, min(repeats, 5))
        figures["twin backward"] = milliseconds(plain.backward, min(repeats, 5))
    wall, busy = time.perf_counter(), time.process_time()
    figures["step"] = milliseconds(lambda: optimiser.step(store, [0], still, pose_rate=0.0), repeats)
    figures["cores_had"] = (time.process_time() - busy) / (time.perf_counter() - wall)
    figures["peak_memory_mb"] = peak_memory_mb()
    return figures

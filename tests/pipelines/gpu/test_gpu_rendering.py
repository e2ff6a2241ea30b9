"""Pictures, lists and gradients of the GPU's kernels are those of the CPU's."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from fields.buffers import device_pairs
from fields.buffers.device_pairs import TILE_HEIGHT, TILE_WIDTH, tile_count
from fields.buffers.tiles import TilePairs
from fields.geometry.camera import PinholeCamera
from fields.map.gaussians import GaussianField
from fields.runtime.backend import initialise
from fields.runtime.engine import ti
from pipelines.render.cpu.binning import Binning
from pipelines.render.formulas import OPAQUE
from pipelines.render.gpu.binning import MEMORY
from pipelines.render.renderer import Renderer
from tests.pipelines.scenes import CAMERA, NEAR, POSE, random_gaussians

BACKGROUND = (0.2, 0.5, 0.9)
NAMES = ("position", "log_scale", "quaternion", "opacity_logit", "sh")
SMALL = PinholeCamera(30.0, 30.0, 9.0, 7.0, 19, 13)
SCENES = {
    "mixed": (CAMERA, random_gaussians(400, seed=8, degree=1)),
    "needles": (CAMERA, random_gaussians(60, seed=5, degree=1, size=(0.05, 40.0))),
    "layers": (CAMERA, random_gaussians(700, seed=7, degree=1, size=(30.0, 60.0), logit=(-2.0, 9.0), beyond=0.0)),
    "small": (SMALL, random_gaussians(40, seed=9, degree=1, camera=SMALL)),
    "unseen": (CAMERA, random_gaussians(20, seed=3, degree=1, depth=(-6.0, -0.5), size=(0.1, 0.2))),
}
Result = dict[str, NDArray]


@ti.data_oriented
class SquareBinning(Binning):
    """The CPU's, in tiles of the GPU's shape."""

    tile_width, tile_height = TILE_WIDTH, TILE_HEIGHT


def rendered(renderer: Renderer, camera: PinholeCamera, state: dict[str, NDArray]) -> Result:
    """Everything that a view of a scene leaves behind, of gradients of 1 in size."""
    renderer.gaussians.load(state)
    renderer.gaussians.clear_gradients()
    view = renderer.render(camera, POSE, NEAR, BACKGROUND)
    rng = np.random.default_rng(1)
    shape = (camera.height, camera.width)
    renderer.images.set_gradients(rng.normal(size=(*shape, 3)), rng.normal(size=shape), rng.normal(size=shape))
    renderer.backward(with_depth=True)
    tiles = tile_count(camera.width, camera.height)
    result = {"colour": view.colour, "depth": view.depth, "opacity": view.opacity}
    result |= renderer.gaussians.gradients_to_numpy() | {"camera": renderer.camera_gradient()}
    result["touched"] = renderer.gaussians.touched.to_numpy()[: len(state["opacity_logit"])]
    gaussian = renderer.projected.gaussian.to_numpy()
    on_cpu = isinstance(renderer.pairs, TilePairs)
    seen = slice(renderer.projected.seen[None])
    result["order"] = gaussian[renderer.projected.order.to_numpy()[seen]] if on_cpu else gaussian[seen]
    result["reached"] = renderer.pairs.reached.to_numpy()[:tiles]
    if on_cpu:
        SquareBinning(renderer.view, renderer.projected, renderer.pairs).forward()
    for name in ("first", "tile_count"):
        result[name] = getattr(renderer.pairs, name).to_numpy()[:tiles]
    n = renderer.pairs.count
    result["slot"], result["rows"] = (
        values[:n].cpu().numpy().copy() if isinstance(values, torch.Tensor) else values.to_numpy()[:n]
        for values in (renderer.pairs.slot, renderer.pairs.rows)
    )
    result["gaussian"] = gaussian[result.pop("slot")]
    return result


def everything() -> tuple[dict[str, Result], dict[str, Result]]:
    """All scenes, twice in the same renderer."""
    renderer = Renderer(GaussianField(1, max_gaussians=1 << 16), 64, 64)
    return tuple({name: rendered(renderer, *scene) for name, scene in SCENES.items()} for _ in range(2))


@pytest.fixture(scope="module")
def results(on_both: Callable) -> tuple[dict[str, Result], dict[str, Result], dict[str, Result]]:
    """Of the CPU, and twice of the GPU."""
    (cpu, _), (gpu, again) = on_both(everything)
    return cpu, gpu, again


@pytest.fixture(params=SCENES)
def pair(request: pytest.FixtureRequest, results: tuple) -> tuple[Result, Result]:
    return results[0][request.param], results[1][request.param]


def test_pictures_are_those_of_the_cpu(pair: tuple[Result, Result]) -> None:
    """But for what lies behind an opaque pixel: the CPU closes a tile as a whole, the GPU pixel by pixel."""
    cpu, gpu = pair
    for name in ("colour", "opacity", "depth"):
        np.testing.assert_allclose(gpu[name], cpu[name], rtol=0, atol=2 * OPAQUE * max(cpu[name].max(), 1.0))


def test_lists_are_those_of_the_cpu(pair: tuple[Result, Result]) -> None:
    cpu, gpu = pair
    for name in ("order", "tile_count", "gaussian", "rows"):
        np.testing.assert_array_equal(gpu[name], cpu[name])
    some = cpu["tile_count"] > 0
    np.testing.assert_array_equal(gpu["first"][some], cpu["first"][some])


def test_gradients_are_those_of_the_cpu(pair: tuple[Result, Result]) -> None:
    cpu, gpu = pair
    # Where pixels are opaque, the CPU still gives Gaussians behind them up to OPAQUE of each pixel, of either sign:
    # of `rest`, at most 3.6 in ten draws.
    is_opaque = cpu["opacity"].max() > 1 - 2 * OPAQUE
    rest = OPAQUE * np.sqrt(cpu["opacity"].size) if is_opaque else 0.0
    for name in (*NAMES, "camera"):
        tolerance = (1e-3 if is_opaque else 1e-4) * max(np.abs(cpu[name]).max(), 1e-6) + 8 * rest
        np.testing.assert_allclose(gpu[name], cpu[name], rtol=0, atol=tolerance)
    np.testing.assert_array_equal(gpu["touched"], cpu["touched"])


def test_opaque_tiles_end_early(results: tuple) -> None:
    layers = results[1]["layers"]
    assert (layers["reached"] < 0.8 * layers["tile_count"]).all()
    assert layers["opacity"].min() > 1 - 2e-5


def test_two_runs_are_bit_identical(results: tuple) -> None:
    for name in SCENES:
        for key, value in results[1][name].items():
            np.testing.assert_array_equal(results[2][name][key], value, err_msg=f"{name} {key}")


def test_a_step_drops_the_farthest_pairs_until_there_is_room_and_a_picture_never(
    results: tuple, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device_pairs, "STEP", 16)
    renderer = Renderer(GaussianField(1, max_gaussians=1 << 16), 64, 64)

    def picture(exact: bool) -> NDArray:
        renderer.forward(CAMERA, POSE, NEAR, exact)
        return renderer.images.colour_to_numpy()

    few, many = (random_gaussians(n, seed=2, degree=1, logit=(-3.0, -2.0)) for n in (4, 400))
    renderer.gaussians.load(few)
    picture(exact=False)
    renderer.gaussians.load(many)
    first = picture(exact=False)
    kept = renderer.pairs.count
    # Those that were kept are the nearest.
    assert kept == renderer.pairs.room
    assert renderer.pairs.slot[:kept].max().item() == renderer.pairs.emitted_slot[kept - 1].item()
    assert len(set(renderer.pairs.emitted_slot[:kept].tolist())) < 400
    dropped = [picture(exact=False) for _ in range(3)][-1]
    assert renderer.pairs.count > kept
    whole = picture(exact=True)
    np.testing.assert_array_equal(dropped, whole)
    assert np.abs(first - whole).max() > 0.01

    # After many small views there is less room again, and so less to sort.
    renderer.gaussians.load(few)
    renderer.projection.forward()
    for _ in range(MEMORY + 1):
        renderer.binning.forward(exact=True)
    assert renderer.pairs.room == kept

    again = Renderer(GaussianField(1, max_gaussians=1 << 16), 64, 64)
    again.gaussians.load(few)
    again.forward(CAMERA, POSE, NEAR, exact=False)
    again.gaussians.load(many)
    np.testing.assert_array_equal(again.render(CAMERA, POSE, NEAR).colour, whole)


def test_a_gradient_where_pairs_were_dropped_is_that_of_what_was_drawn(
    results: tuple, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The slot at the cut has some of its pairs; those behind it none and no gradient."""
    monkeypatch.setattr(device_pairs, "STEP", 16)
    renderer = Renderer(GaussianField(1, max_gaussians=1 << 16), 64, 64)
    few, many = (random_gaussians(n, seed=2, degree=1) for n in (4, 300))
    renderer.gaussians.load(few)
    renderer.forward(CAMERA, POSE, NEAR, exact=False)
    renderer.gaussians.load(many)
    renderer.forward(CAMERA, POSE, NEAR, exact=False)
    shape = (CAMERA.height, CAMERA.width)
    renderer.images.set_gradients(np.ones((*shape, 3)), np.zeros(shape), np.zeros(shape))
    renderer.backward()
    gradients = renderer.gaussians.gradients_to_numpy()
    order = renderer.projected.gaussian.to_numpy()[: renderer.projected.seen[None]]
    drawn = sorted(set(renderer.pairs.emitted_slot[: renderer.pairs.room].tolist()))
    assert len(drawn) < len(order)
    assert np.abs(gradients["sh"][order[drawn]]).max() > 0
    for value in gradients.values():
        assert np.isfinite(value).all()
        assert (value[order[drawn[-1] + 1 :]] == 0).all()


def test_images_of_1280x720_are_rendered(gpu: str) -> None:
    """More numbers than many drivers start threads for at once."""
    initialise(gpu)
    camera = CAMERA.resized(1280, 720)
    renderer = Renderer(GaussianField(0, max_gaussians=1 << 10), camera.width, camera.height)
    renderer.gaussians.load(random_gaussians(50, seed=8, camera=camera))
    view = renderer.render(camera, POSE, NEAR)
    assert view.opacity.shape == (720, 1280) and view.opacity.max() > 0.5

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.buffers.tiles import TILE_HEIGHT, TILE_WIDTH
from fields.runtime.engine import ti
from pipelines.render.cpu.projection import ALPHA_MIN
from pipelines.render.renderer import Renderer
from tests.pipelines import reference
from tests.pipelines.scenes import CAMERA, NEAR, POSE, random_gaussians

Lists = dict[int, list[tuple[int, int, int]]]


def lists(renderer: Renderer, state: dict[str, NDArray]) -> tuple[Lists, NDArray]:
    """(rank in depth, first row, row behind the last) of every tile, and the Gaussian of every rank."""
    renderer.gaussians.load(state)
    renderer.forward(CAMERA, POSE, NEAR)
    pairs = renderer.pairs
    slot, rows = pairs.slot.to_numpy()[: pairs.count], pairs.rows_to_numpy()
    first, count = pairs.first.to_numpy(), pairs.tile_count.to_numpy()
    order = renderer.projected.order.to_numpy()[: renderer.projected.count]
    rank = np.argsort(order)
    tiles = -(-CAMERA.width // TILE_WIDTH) * -(-CAMERA.height // TILE_HEIGHT)
    result: Lists = {}
    for tile in range(tiles):
        span = slice(first[tile], first[tile] + count[tile])
        ranks = rank[slot[span]]
        result[tile] = [(int(k), int(r & 0xFFFF), int(r >> 16)) for k, r in zip(ranks, rows[span], strict=True)]
    return result, renderer.projected.gaussian.to_numpy()[order]


@pytest.fixture(params=[(0.5, 5.0), (0.05, 40.0)], ids=["small", "needles"])
def case(request: pytest.FixtureRequest, renderers: Callable[..., Renderer]) -> tuple[Lists, NDArray, NDArray]:
    """Lists, Gaussians by rank in depth, and alpha (N, H, W) of the plain renderer by Gaussian."""
    state = random_gaussians(150, seed=4, size=request.param, logit=(-5.0, 3.0))
    splats = reference.project(state, CAMERA, POSE, NEAR)
    alpha = np.zeros((150, CAMERA.height, CAMERA.width))
    alpha[splats.index] = splats.alpha(CAMERA.width, CAMERA.height)
    return *lists(renderers(0, ti.f64), state), alpha


def reached(alpha: NDArray, tile: int) -> NDArray[np.bool_]:
    """Which rows (N, rows) of a tile each Gaussian is drawn on."""
    tiles_x = -(-CAMERA.width // TILE_WIDTH)
    y, x = tile // tiles_x * TILE_HEIGHT, tile % tiles_x * TILE_WIDTH
    return (alpha[:, y : y + TILE_HEIGHT, x : x + TILE_WIDTH] >= ALPHA_MIN).any(axis=2)


def test_no_pixel_misses_a_gaussian_that_reaches_it(case: tuple[Lists, NDArray, NDArray]) -> None:
    tiles, gaussian, alpha = case
    for tile, entries in tiles.items():
        listed = {int(gaussian[k]): (top, bottom) for k, top, bottom in entries}
        for g, row in np.argwhere(reached(alpha, tile)):
            assert listed[int(g)][0] <= row < listed[int(g)][1]


def test_few_pairs_are_listed_in_vain(case: tuple[Lists, NDArray, NDArray]) -> None:
    tiles, _, alpha = case
    listed = sum(len(entries) for entries in tiles.values())
    needed = sum(int(reached(alpha, tile).any(axis=1).sum()) for tile in tiles)
    # An ellipse may touch a tile between its pixel centres, no more.
    assert needed <= listed <= 1.15 * needed


def test_lists_are_in_order_of_depth_and_name_no_gaussian_twice(case: tuple[Lists, NDArray, NDArray]) -> None:
    for entries in case[0].values():
        ranks = [k for k, _, _ in entries]
        assert ranks == sorted(set(ranks))


def test_slots_are_in_the_order_of_the_gaussians_and_ordered_by_depth(renderers: Callable[..., Renderer]) -> None:
    renderer = renderers(0, ti.f64)
    lists(renderer, random_gaussians(150, seed=4))
    count = renderer.projected.count
    order = renderer.projected.order.to_numpy()[:count]
    assert (np.diff(renderer.projected.gaussian.to_numpy()[:count]) > 0).all()
    assert (np.diff(renderer.projected.depth.to_numpy()[order]) >= 0).all()
    assert sorted(order) == list(range(count))


def test_every_slot_finds_its_pairs_again(renderers: Callable[..., Renderer]) -> None:
    renderer = renderers(0, ti.f64)
    lists(renderer, random_gaussians(300, seed=6))
    count = renderer.pairs.count
    first, end = renderer.projected.first_pair.to_numpy(), renderer.projected.end_pair.to_numpy()
    position = renderer.pairs.position.to_numpy()[:count]
    slot = renderer.pairs.slot.to_numpy()[:count]
    assert sorted(position) == list(range(count))
    for s in range(renderer.projected.count):
        assert (slot[position[first[s] : end[s]]] == s).all()
    assert sum(end[s] - first[s] for s in range(renderer.projected.count)) == count

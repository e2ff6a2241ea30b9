"""Levels of detail: what is drawn of each block, and that nothing is drawn twice or left out."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from pipelines.whole.hierarchy import LEVELS, Hierarchy
from tests.pipelines.blocks.test_merging import some

FOCAL = 300.0


@pytest.fixture(scope="module")
def street() -> Hierarchy:
    """20,000 Gaussians along 80 units of a street."""
    state = some(20_000)
    state["position"][:, 2] = 20.0 * state["position"][:, 2] + 40.0
    return Hierarchy(state)


def test_a_level_has_fewer_gaussians_than_the_one_above(street: Hierarchy) -> None:
    counts = [len(street.level(number)) for number in range(LEVELS + 1)]
    assert counts[0] == 20_000 and all(below < 0.8 * above for above, below in pairwise(counts))
    assert np.array_equal(np.sort(street.level(0).places), np.arange(20_000))


def test_a_map_that_fits_is_drawn_as_it_is(street: Hierarchy) -> None:
    blocks = np.arange(len(street.blocks))
    assert (street.levels_for(blocks, np.zeros(3), FOCAL, 20_000) == 0).all()
    drawn = street.gaussians(blocks, np.zeros(len(blocks), dtype=np.int64))
    for name, values in street.level(0).values.items():
        np.testing.assert_array_equal(drawn[name], values[street.blocks.members])


@pytest.mark.parametrize("most", [15_000, 8_000, 3_000])
def test_far_blocks_lose_detail_first_until_all_fit(street: Hierarchy, most: int) -> None:
    blocks = np.arange(len(street.blocks))
    levels = street.levels_for(blocks, np.zeros(3), FOCAL, most)
    assert levels.min() >= 0
    drawn = street.gaussians(blocks, levels)
    assert 0.5 * most < len(drawn["position"]) <= most
    distance = street.blocks.boxes.distance(np.zeros(3))
    assert (np.diff(levels[np.argsort(distance)]) >= 0).all()
    # Every block is there: its Gaussians lie in its box.
    for block, level in zip(blocks, levels, strict=True):
        there = street.gaussians(np.array([block]), np.array([level]))["position"]
        box = street.blocks.boxes[np.array([block])]
        assert len(there) and (there >= box.low - 1e-5).all() and (there <= box.high + 1e-5).all()


def test_of_more_blocks_than_fit_the_nearest_are_drawn(street: Hierarchy) -> None:
    blocks = np.arange(len(street.blocks))
    levels = street.levels_for(blocks, np.zeros(3), FOCAL, 100)
    distance = street.blocks.boxes.distance(np.zeros(3))
    assert (levels < 0).any() and (levels >= 0).any()
    assert distance[levels >= 0].max() <= distance[levels < 0].min()


def test_nothing_is_drawn_of_no_blocks(street: Hierarchy) -> None:
    none = np.zeros(0, dtype=np.int64)
    assert len(street.gaussians(none, street.levels_for(none, np.zeros(3), FOCAL, 10))["position"]) == 0

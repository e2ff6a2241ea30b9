"""Every place belongs to one map: the rule against a plain twin, and what follows from it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.whole.merge import Shown, owned

EDGE = 0.5


def maps(seed: int, count: int = 3, spread: float = 1.2) -> list[Shown]:
    """Maps of random places that overlap. A fifth of the Gaussians does not show."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(20, 60, count)
    return [
        Shown(
            rng.normal([0.6 * number, 0.0, 0.0], spread, (size, 3)),
            np.where(rng.random(size) < 0.2, 0.0, rng.integers(1, 50, size)).astype(np.float32),
        )
        for number, size in enumerate(sizes)
    ]


def plainly_owned(maps: list[Shown], edge: float) -> list[NDArray[np.bool_]]:
    """The rule, for one Gaussian after the other."""

    def cube(position: NDArray[np.floating]) -> tuple[int, ...]:
        return tuple(int(np.floor(c / edge)) for c in position)

    def score(number: int, wanted: tuple[int, ...], reach: int) -> float:
        total = 0.0
        for position, coverage in zip(maps[number].position, maps[number].coverage, strict=True):
            if max(abs(a - b) for a, b in zip(cube(position), wanted, strict=True)) <= reach:
                total += float(coverage)
        return total

    def owner(wanted: tuple[int, ...]) -> int:
        bids = [score(number, wanted, 1) if score(number, wanted, 0) > 0 else 0.0 for number in range(len(maps))]
        return bids.index(max(bids)) if max(bids) > 0 else -1

    return [
        np.array(
            [coverage > 0 and owner(cube(x)) == number for x, coverage in zip(m.position, m.coverage, strict=True)]
        )
        for number, m in enumerate(maps)
    ]


@pytest.mark.parametrize("seed", range(4))
def test_the_rule_is_that_of_the_plain_twin(seed: int) -> None:
    given = maps(seed)
    for found, expected in zip(owned(given, EDGE), plainly_owned(given, EDGE), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_a_place_that_only_one_map_shows_stays_whole() -> None:
    first, second = maps(5, count=2)
    far = Shown(second.position + np.array([100.0, 0.0, 0.0]), second.coverage)
    for kept, each in zip(owned([first, far], EDGE), (first, far), strict=True):
        np.testing.assert_array_equal(kept, each.coverage > 0)


def test_no_cube_keeps_gaussians_of_two_maps() -> None:
    given = maps(6, count=4, spread=0.8)
    kept = owned(given, EDGE)
    cubes = [set(map(tuple, np.floor(m.position[k] / EDGE).astype(int))) for m, k in zip(given, kept, strict=True)]
    assert sum(map(len, cubes)) == len(set().union(*cubes))
    assert all(kept_here.any() for kept_here in kept)


def test_what_lies_at_infinity_is_taken_as_one_cube() -> None:
    near = Shown(np.array([[1e30, 0.0, 0.0], [-1e30, 0.0, 0.0]]), np.array([2.0, 1.0]))
    other = Shown(np.array([[3e30, 0.0, 0.0], [-2e30, 0.0, 0.0]]), np.array([1.0, 2.0]))
    assert [kept.tolist() for kept in owned([near, other], EDGE)] == [[True, False], [False, True]]

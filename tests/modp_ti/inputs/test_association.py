"""Time stamps are associated as the TUM benchmark's tools describe it: the nearest first, one to one, within reach."""

from __future__ import annotations

import numpy as np
import pytest

from modp_ti.inputs.timed_poses import associate


def by_hand(a, b, max_difference):
    """All pairs within reach, sorted by difference, taken while both are free."""
    pairs = sorted((abs(x - y), i, j) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) <= max_difference)
    taken = []
    for _, i, j in pairs:
        if all(i != p and j != q for p, q in taken):
            taken.append((i, j))
    return sorted(taken)


@pytest.mark.parametrize("reach", [0.004, 0.02, 0.3, 5.0])
def test_pairs_are_those_of_the_description(reach):
    rng = np.random.default_rng(3)
    a, b = np.cumsum(rng.uniform(0, 0.05, 60)), rng.permutation(np.cumsum(rng.uniform(0, 0.04, 80)))
    found = associate(1305031452 + a, 1305031452 + b, reach)
    assert found.dtype == np.int64
    assert [tuple(pair) for pair in found] == by_hand(1305031452 + a, 1305031452 + b, reach)


def test_nearer_pair_is_taken_first_and_no_entry_twice():
    assert associate([1.000, 1.010], [1.008], 0.02).tolist() == [[1, 0]]
    # 1.00 lies nearest to 1.01, which belongs to 1.012 more: it gets what is left within reach, or nothing.
    assert associate([1.000, 1.012], [1.010, 0.985], 0.02).tolist() == [[0, 1], [1, 0]]
    assert associate([1.000, 1.012], [1.010, 0.97], 0.02).tolist() == [[1, 0]]


def test_reach_is_twenty_milliseconds_unless_said_otherwise():
    assert associate([0.0, 1.0], [0.019, 1.021]).tolist() == [[0, 0]]


def test_nothing_within_reach_gives_no_pair():
    for a, b in (([], []), ([1.0], []), ([], [1.0]), ([1.0], [2.0])):
        assert associate(a, b).shape == (0, 2)


def test_time_that_is_no_number_is_refused():
    with pytest.raises(ValueError, match="finite"):
        associate([np.nan], [1.0])

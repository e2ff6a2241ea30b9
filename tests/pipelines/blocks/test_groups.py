from __future__ import annotations

import numpy as np

from pipelines.companions.paging import grouped


def test_a_group_ends_before_it_would_see_more_than_fits() -> None:
    seen = np.array([[1, 1, 0, 0, 0], [0, 1, 1, 0, 0], [0, 0, 1, 1, 0], [0, 0, 0, 1, 1], [0, 0, 0, 0, 1]], dtype=bool)
    counts = np.array([10, 20, 30, 40, 50])
    for room in (60, 90, 100, 150, 1000):
        group = grouped(seen, counts, room)
        assert group[0] == 0 and set(np.diff(group)) <= {0, 1}
        for number in range(group[-1] + 1):
            together = counts[seen[group == number].any(axis=0)].sum()
            assert together <= room or (group == number).sum() == 1
            if number < group[-1]:  # one more would not have fitted
                following = np.flatnonzero(group == number)[-1] + 1
                assert counts[seen[group == number].any(axis=0) | seen[following]].sum() > room


def test_a_group_ends_before_another_place_that_does_not_fit_whole() -> None:
    """Keyframes 0 to 2 see one place, 3 to 6 another; the last one does not fit beside the first place."""
    seen = np.zeros((7, 8), dtype=bool)
    seen[[0, 1, 2], [0, 1, 2]] = seen[[0, 1, 2], [1, 2, 3]] = True
    seen[[3, 4, 5, 6], [4, 5, 6, 7]] = seen[3:, 4] = True
    counts = np.full(8, 10)
    assert grouped(seen, counts, 70).tolist() == [0, 0, 0, 1, 1, 1, 1]
    seen[3:, 3] = True  # a block of both: a fifth of what the later keyframes of the group see
    assert grouped(seen, counts, 70).tolist() == [0, 0, 0, 0, 0, 0, 1]
    counts[3] = 1  # now hardly any
    assert grouped(seen, counts, 65).tolist() == [0, 0, 0, 1, 1, 1, 1]


def test_everything_that_fits_is_one_group() -> None:
    assert grouped(np.ones((4, 2), dtype=bool), np.array([3, 4]), 7).tolist() == [0, 0, 0, 0]


def test_a_keyframe_that_sees_more_than_fits_is_alone() -> None:
    seen = np.array([[1, 0], [1, 1], [0, 1]], dtype=bool)
    assert grouped(seen, np.array([5, 6]), 7).tolist() == [0, 1, 2]


def test_no_keyframes_are_no_groups() -> None:
    assert grouped(np.zeros((0, 2), dtype=bool), np.array([3, 4]), 7).tolist() == []

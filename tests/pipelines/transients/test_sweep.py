"""Which keyframes are asked about a view."""

from __future__ import annotations

import numpy as np

from pipelines.companions.transients import neighbours


def test_neighbours_are_other_keyframes_near_and_far() -> None:
    for count in (1, 2, 9, 40, 200):
        for place in range(count):
            found = neighbours(place, count)
            assert len(set(found)) == len(found) <= 36
            assert all(0 <= other < count and abs(other - place) > 1 for other in found)
    far = neighbours(0, 200)
    assert np.diff(far).max() <= 13 and far[-1] >= 187

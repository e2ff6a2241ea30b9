from __future__ import annotations

import numpy as np
import pytest

from fields.map.running_median import RunningMedian


def test_it_is_the_median_of_what_came_so_far() -> None:
    values = np.random.default_rng(0).choice(40, 101).astype(float) / 7
    median = RunningMedian()
    for n, value in enumerate(values.tolist(), 1):
        median.add(value)
        assert len(median) == n
        assert median.value == np.median(values[:n])


def test_nothing_has_no_median() -> None:
    with pytest.raises(IndexError):
        _ = RunningMedian().value

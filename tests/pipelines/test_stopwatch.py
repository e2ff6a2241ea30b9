from __future__ import annotations

import time

import pytest

from pipelines.stopwatch import Stopwatch


def test_times_of_a_stage_add_up() -> None:
    watch = Stopwatch()
    for _ in range(3):
        with watch.measure("render"):
            time.sleep(0.01)
    with watch.measure("loss"):
        pass
    assert watch.seconds["render"] >= 0.03
    assert 0 <= watch.seconds["loss"] < watch.seconds["render"]


def test_a_stage_that_fails_is_counted_too() -> None:
    watch = Stopwatch()
    with pytest.raises(KeyError), watch.measure("render"):
        time.sleep(0.01)
        raise KeyError
    assert watch.seconds["render"] >= 0.01

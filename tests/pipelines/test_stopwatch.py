from __future__ import annotations

import time

import pytest

from pipelines.stopwatch import Stopwatch, breakdown_percent


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


def test_the_breakdown_is_the_share_of_each_stage() -> None:
    seconds = {"optimise": 8.0, "select": 0.5, "depth": 0.25, "read": 1.0, "refine": 99.0}
    assert breakdown_percent(seconds, 10.0) == {
        "optimise": 80.0,
        "select": 5.0,
        "depth": 2.5,
        "occupancy": 0.0,
        "others": 12.5,
    }

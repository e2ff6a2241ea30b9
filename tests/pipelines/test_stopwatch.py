from __future__ import annotations

import pytest

from pipelines import pipeline
from pipelines.pipeline import Stopwatch, breakdown_percent


def test_times_of_a_stage_add_up_also_of_one_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    now = iter([0.0, 3.0, 10.0, 14.0, 20.0, 21.0])
    monkeypatch.setattr(pipeline.time, "perf_counter", lambda: next(now))
    watch = Stopwatch()
    with watch.measure("render"):
        pass
    with pytest.raises(KeyError), watch.measure("render"):
        raise KeyError
    with watch.measure("loss"):
        pass
    assert watch.seconds == {"render": 7.0, "loss": 1.0}


def test_the_breakdown_is_the_share_of_each_stage() -> None:
    seconds = {"optimise": 8.0, "select": 0.5, "depth": 0.25, "read": 1.0, "refine": 99.0}
    expected = {"optimise": 80.0, "select": 5.0, "depth": 2.5, "occupancy": 0.0, "others": 12.5}
    assert breakdown_percent(seconds, 10.0) == expected

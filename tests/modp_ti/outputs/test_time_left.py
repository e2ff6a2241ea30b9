from __future__ import annotations

import pytest

from modp_ti.outputs.time_left import TimeLeft, duration


class Clock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def after(left: TimeLeft, clock: Clock, costs: list[float], done: int = 0) -> None:
    """Finish an item after each of the given times [s]."""
    for number, cost in enumerate(costs, done + 1):
        clock.now += cost
        left.update(number)


def test_items_that_take_the_same_time_are_estimated_exactly() -> None:
    clock = Clock()
    left = TimeLeft(100, clock=clock)
    after(left, clock, [0.5] * 40)
    assert left.seconds() == pytest.approx(30.0)


def test_the_pace_is_that_of_the_last_third() -> None:
    """Items that become slower: the overall mean would promise 60 x 1 s where each takes 2 s."""
    clock = Clock()
    left = TimeLeft(100, clock=clock)
    after(left, clock, [0.5] * 20 + [1.0] * 10 + [2.0] * 10)
    assert left.seconds() == pytest.approx(60 * 2.0)


def test_a_resumed_run_counts_only_its_own_items() -> None:
    clock = Clock()
    left = TimeLeft(100, done=80, clock=clock)
    after(left, clock, [2.0] * 10, done=80)
    assert left.seconds() == pytest.approx(20.0)


def test_nothing_is_promised_early_or_for_a_stream() -> None:
    clock = Clock()
    left, stream = TimeLeft(100, clock=clock), TimeLeft(None, clock=clock)
    after(left, clock, [3.0] * 3)
    assert left.seconds() is None
    after(stream, clock, [3.0] * 10)
    assert stream.seconds() is None


def test_no_item_for_long_is_no_estimate() -> None:
    clock = Clock()
    left = TimeLeft(100, clock=clock)
    clock.now += 60.0
    assert left.seconds() is None


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.2, "0 s"), (40.4, "40 s"), (59.6, "1 min"), (150, "2 min"), (3570, "1 h 0 min"), (4800, "1 h 20 min")],
)
def test_durations_are_written_as_a_person_would(seconds: float, text: str) -> None:
    assert duration(seconds) == text

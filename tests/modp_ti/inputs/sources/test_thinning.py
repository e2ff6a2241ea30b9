"""A tracker that keeps up gets every frame; one that does not gets every n-th. The clocks are made up."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from modp_ti.inputs.sources import backlog as backlogs
from modp_ti.inputs.sources.backlog import Backlog
from modp_ti.inputs.sources.thinning import Thinning


def played(arrivals: Sequence[float], cost: Callable[[int], float]) -> tuple[list[int], list[float], Backlog[int]]:
    """Play a stream to a tracker that takes `cost(i)` seconds for its i-th frame.

    Returns the numbers of the frames that it got, the age of each when it got it [s], and the queue at the end.
    """
    backlog: Backlog[int] = Backlog()
    now, come = 0.0, 0
    numbers: list[int] = []
    ages: list[float] = []
    while True:
        while come < len(arrivals) and arrivals[come] <= now:
            backlog.add(arrivals[come], come)
            come += 1
        taken = backlog.take(now)
        if taken is not None:
            numbers.append(taken[1])
            ages.append(now - taken[0])
            now += cost(len(numbers) - 1)
        elif come < len(arrivals):
            now = max(now, arrivals[come])
        else:
            return numbers, ages, backlog


def at(rate: float, seconds: float) -> list[float]:
    return [i / rate for i in range(round(rate * seconds))]


def test_every_frame_is_tracked_by_a_tracker_that_keeps_up():
    numbers, ages, _ = played(at(10, 60), lambda _: 0.06)
    assert numbers == list(range(600))
    assert max(ages) < 0.001


def test_a_faster_camera_is_thinned_evenly():
    arrivals = at(30, 60)
    numbers, ages, backlog = played(arrivals, lambda _: 0.06)
    gaps = np.diff(numbers)
    assert set(gaps[10:]) == {2}, "every second one, after a short beginning"
    assert gaps.max() / 30 <= 0.15
    assert max(ages[30:]) < 0.2
    counts = backlog.arrivals
    assert (counts.arrived, counts.thinned, counts.newest) == (1800, 1800 - len(numbers), arrivals[-1])


@pytest.mark.parametrize(("rate", "mean"), [(10, 0.06), (30, 0.06), (30, 0.025), (30, 0.2), (60, 0.06)])
def test_uneven_costs_and_arrivals_leave_no_long_gap_and_no_lag(rate, mean):
    rng = np.random.default_rng(3)
    arrivals = np.sort(np.array(at(rate, 60)) + rng.uniform(0, 0.5 / rate, rate * 60))
    # Every fourth frame is a keyframe and takes four times as long.
    numbers, ages, _ = played(arrivals.tolist(), lambda i: mean * (16 / 7 if i % 4 == 0 else 4 / 7))
    keeps_up = max(1, int(np.ceil(mean * rate)))
    gaps = np.diff(numbers)
    assert gaps.max() <= 2 * keeps_up
    assert gaps.mean() <= 1.35 * max(1.0, mean * rate)
    assert max(ages[30:]) < 1.0
    if mean * rate < 0.8:
        assert gaps.max() == 1


def test_a_hiccup_of_a_second_is_absorbed():
    numbers, ages, _ = played(at(10, 30), lambda i: 1.0 if i == 100 else 0.06)
    assert numbers == list(range(300))
    assert max(ages[130:]) < 0.001


def test_the_backlog_of_a_long_pause_is_worked_off_with_fewer_frames_evenly():
    numbers, ages, _ = played(at(10, 60), lambda i: 8.0 if i == 100 else 0.06)
    gaps = np.diff(numbers)
    assert set(gaps) == {1, 2}
    thinned = np.flatnonzero(gaps == 2)
    assert set(np.diff(thinned)) == {1}, "in one run"
    assert len(numbers) > 540
    caught_up = int(np.argmax(np.array(ages[102:]) < 0.1)) + 102
    assert (numbers[caught_up] - numbers[101]) / 10 < 8.0 + 5.0
    assert set(gaps[caught_up:]) == {1}


def test_the_time_in_which_the_tracker_is_opened_thins_nothing():
    numbers, _, _ = played(at(10, 30), lambda i: 1.0 if i == 0 else 0.06)
    assert numbers == list(range(300))


def test_a_pause_of_the_stream_changes_nothing():
    arrivals = [t if t < 20 else t + 5.0 for t in at(30, 40)]
    gaps = np.diff(played(arrivals, lambda _: 0.06)[0])
    assert set(gaps[10:]) == {2}


def test_what_a_network_held_back_is_thinned_evenly_when_it_comes_at_once():
    arrivals = [t if t < 20 else max(t, 25.0 + (t - 20.0) / 100) for t in at(30, 60)]
    numbers, ages, _ = played(arrivals, lambda _: 0.06)
    assert np.diff(numbers).max() <= 8
    assert max(ages[-300:]) < 0.2


def test_the_stride_changes_by_one_at_a_time():
    policy = Thinning()
    for i in range(20):
        policy.arrived(i / 100)
        policy.tracked(0.1)
    assert policy.load == pytest.approx(10.0)
    assert [policy.stride(0.0) for _ in range(10)] == [2, 3, 4, 5, 6, 7, 8, 9, 10, 10]
    for _ in range(200):
        policy.tracked(0.01)
    assert [policy.stride(0.0) for _ in range(9)] == [9, 8, 7, 6, 5, 4, 3, 2, 2], "one would leave it no room"


def test_too_many_waiting_frames_are_halved_evenly(monkeypatch):
    monkeypatch.setattr(backlogs, "LIMIT", 8)
    dropped: list[int] = []
    backlog: Backlog[int] = Backlog(dropped.append)
    for i in range(20):
        backlog.add(0.1 * i, i)
    assert len(backlog) <= 8
    left = [backlog._waiting[i][1] for i in range(len(backlog))]
    assert sorted(left + dropped) == list(range(20))
    assert left[-1] == 19
    assert max(np.diff(left)) <= 5
    assert backlog.arrivals.thinned == len(dropped)
    backlog.clear()
    assert len(backlog) == 0
    assert backlog.arrivals.arrived == backlog.arrivals.thinned


def test_frames_are_not_left_out_before_the_first_is_taken():
    backlog: Backlog[int] = Backlog()
    for i in range(5):
        backlog.add(0.1 * i, i)
    assert backlog.take(100.0) == (0.0, 0)
    assert backlog.take(100.1) == (0.1, 1)

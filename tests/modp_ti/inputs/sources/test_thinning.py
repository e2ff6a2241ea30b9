"""A tracker that keeps up gets every frame; one that does not gets every n-th. The clocks are made up."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from modp_ti.inputs.sources import backlog as backlogs
from modp_ti.inputs.sources.backlog import Backlog


def played(
    arrivals: Sequence[float], cost: Callable[[int], float], numbers: list[int] | None = None
) -> tuple[list[int], list[float], Backlog[int]]:
    """Play a stream to a tracker that takes `cost(i)` seconds for its i-th frame, which is appended to `numbers`.

    Returns the numbers of the frames that it got, the age of each when it got it [s], and the queue at the end.
    """
    backlog: Backlog[int] = Backlog()
    now, come = 0.0, 0
    numbers = [] if numbers is None else numbers
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
    assert gaps[10:].min() >= 1
    assert gaps.max() == 2, "1.8 frames come while one is tracked"
    assert len(numbers) >= 1800 * 0.033 / 0.06 * 0.93, "no more are left out than must be"
    assert max(ages[30:]) < 0.2
    counts = backlog.arrivals
    assert (counts.arrived, counts.thinned, counts.newest) == (1800, 1800 - len(numbers), arrivals[-1])


@pytest.mark.parametrize(("rate", "mean"), [(10, 0.06), (30, 0.06), (30, 0.025), (30, 0.2), (60, 0.06)])
def test_uneven_costs_and_arrivals_leave_no_long_gap_and_no_lag(rate, mean):
    rng = np.random.default_rng(3)
    arrivals = np.sort(np.array(at(rate, 60)) + rng.uniform(0, 0.5 / rate, rate * 60))
    # Every fourth frame is a keyframe and takes four times as long.
    numbers, ages, _ = played(arrivals.tolist(), lambda i: mean * (16 / 7 if i % 4 == 0 else 4 / 7))
    gaps = np.diff(numbers)
    assert gaps.max() <= max(np.ceil(1.35 * mean * rate), np.floor(0.15 * rate))
    assert gaps.mean() <= 1.2 * max(1.0, mean * rate)
    assert max(ages[30:]) < 1.3
    if mean * rate < 0.8:
        assert gaps.max() == 1


def test_the_backlog_of_a_long_pause_is_worked_off_with_fewer_frames_evenly():
    numbers, ages, _ = played(at(10, 60), lambda i: 8.0 if i == 100 else 0.06)
    gaps = np.diff(numbers)
    assert set(gaps) == {1, 2}
    assert len(numbers) > 540
    caught_up = int(np.argmax(np.array(ages[102:]) < 0.1)) + 102
    # Frames are left out only while the lag exceeds 4 s; the rest of it shrinks by 0.4 s in a second of the stream.
    assert (numbers[caught_up] - numbers[101]) / 10 < 8.0 + 4.0 / 0.4
    assert set(gaps[caught_up:]) == {1}


def test_a_pause_of_the_stream_changes_nothing():
    whole = at(30, 40)
    numbers, _, _ = played(whole, lambda _: 0.06)
    paused, _, _ = played([t if t < 20 else t + 5.0 for t in whole], lambda _: 0.06)
    assert len(paused) == pytest.approx(len(numbers), abs=5)
    assert np.diff(paused).max() == 2


def test_too_many_waiting_frames_are_halved_evenly(monkeypatch):
    monkeypatch.setattr(backlogs, "LIMIT", 8)
    dropped: list[int] = []
    backlog: Backlog[int] = Backlog(dropped.append)
    for i in range(20):
        backlog.add(0.1 * i, i)
    assert len(backlog) <= 8
    left = [item for _, item in backlog._waiting if item is not None]
    assert sorted(left + dropped) == list(range(20))
    assert left[-1] == 19
    assert max(np.diff(left)) <= 5
    assert backlog.arrivals.thinned == len(dropped)
    backlog.clear()
    assert len(backlog) == 0
    assert backlog.arrivals.arrived == backlog.arrivals.thinned


def taken_and_decoded(rate: int, every: bool) -> tuple[list[int], int]:
    """Play a minute to a tracker of 80 ms a frame. Returns the frames that it got, and the number of decoded ones.

    Args:
        every: Decode every frame, wanted or not.
    """
    backlog: Backlog[int] = Backlog()
    free, decoded, taken = 0.0, 0, []
    for number, time in enumerate(at(rate, 60)):
        wanted = every or backlog.wants()
        decoded += wanted
        backlog.add(time, number if wanted else None)
        if time >= free and (found := backlog.take(time)) is not None:
            taken.append(found[1])
            free = time + 0.08
    counts = backlog.arrivals
    assert counts.arrived == 60 * rate == len(taken) + counts.thinned + len(backlog)
    return taken, decoded


@pytest.mark.parametrize(("rate", "share"), [(30, 1.0), (120, 0.6), (240, 0.4)])
def test_frames_that_will_be_left_out_are_not_decoded(rate: int, share: float) -> None:
    taken, decoded = taken_and_decoded(rate, every=False)
    expected, _ = taken_and_decoded(rate, every=True)
    assert decoded <= share * 60 * rate
    assert taken == sorted(set(taken))
    assert len(taken) >= 0.85 * len(expected)
    assert np.diff(taken)[10:].max() <= 1.5 * np.diff(expected)[10:].max()

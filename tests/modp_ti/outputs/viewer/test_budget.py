"""The viewer's cost stays below its share of the time, whatever a picture costs."""

from __future__ import annotations

import threading

import pytest

from modp_ti.outputs.viewer.handover import CostLimit, ThreadClock


class Clock:
    """Seconds that pass when told so."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.mark.parametrize("picture", [0.001, 0.05, 0.7])
@pytest.mark.parametrize("frame", [0.02, 1.0])
def test_the_cost_comes_to_the_share_and_no_more_than_one_picture_beyond(picture: float, frame: float):
    clock = Clock()
    limit = CostLimit(0.05, clock)
    mapping = pictures = 0.0
    while mapping < 400.0:
        clock.now += frame
        mapping += frame
        if limit.allows():
            with limit.measured():
                clock.now += picture
            pictures += picture
    assert limit.cost == pytest.approx(pictures)
    # What viewing takes earns a share too: c / (mapping + c) = share.
    most = 0.05 * mapping / 0.95
    assert pictures <= most + picture
    assert pictures >= min(most - 2 * picture, 0.95 * mapping / frame * picture)


def test_what_is_saved_up_while_nobody_looks_is_bounded():
    clock = Clock()
    limit = CostLimit(0.05, clock)
    clock.now += 36_000.0
    spent = 0.0
    while limit.allows():
        limit.charge(0.01)
        spent += 0.01
    assert spent == pytest.approx(0.05 * 60.0, abs=0.02)


def test_a_charge_of_other_threads_counts():
    clock = Clock()
    limit = CostLimit(0.1, clock)
    clock.now += 10.0
    limit.charge(1.5)  # 0.5 s more than there is
    assert not limit.allows()
    clock.now += 4.9
    assert not limit.allows()
    clock.now += 0.2
    assert limit.allows()


def test_nothing_comes_in_while_the_mapper_is_held():
    clock = Clock()
    limit = CostLimit(0.1, clock)
    limit.charge(1.0)
    with limit.suspended():
        clock.now += 1000.0
    assert not limit.allows()


def test_the_clock_of_threads_tells_their_work_and_not_that_of_others():
    work, stop = threading.Event(), threading.Event()

    def worker() -> None:
        while not stop.is_set():
            work.wait()
            sum(range(10_000))

    thread = threading.Thread(target=worker, daemon=True)
    thread.start()
    clock = ThreadClock([thread])
    sum(range(3_000_000))
    idle = clock.since_last()
    work.set()
    busy = 0.0
    while busy < 0.05:
        busy += clock.since_last()
    stop.set()
    thread.join()
    assert idle < 0.01

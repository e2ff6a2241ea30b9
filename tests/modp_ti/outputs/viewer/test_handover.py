"""The hand-over between the mapping thread and the viewer: bounded, the latest wins, its cost stays below a share."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from modp_ti.outputs.viewer.handover import MAX_BROWSERS, BrowserCamera, CostLimit, Gate, Latest, Requests, ThreadClock
from tests.patience import PATIENCE


def camera(client: int, x: float = 0.0, mode: str = "colour") -> BrowserCamera:
    return BrowserCamera(client, np.array([1.0, 0, 0, 0]), np.array([x, 0, 0]), 1.0, 640, 480, mode)


def test_only_the_latest_value_waits_and_takes_over_what_it_lacks():
    box: Latest[dict] = Latest(lambda newer, waiting: waiting | newer)
    box.put({"splats": 1, "numbers": 0})
    for value in range(1000):
        box.put({"numbers": value})
    assert box.take(timeout=0.0) == {"splats": 1, "numbers": 999}
    assert box.take(timeout=0.0) is None


def test_whoever_waits_for_a_value_gets_it_and_is_let_go_at_the_end():
    box: Latest[str] = Latest()
    got: list[str | None] = []

    def wait() -> None:
        while not box.closed:
            got.append(box.take())

    thread = threading.Thread(target=wait)
    thread.start()
    box.put("picture")
    while not got:
        pass
    box.close()
    thread.join(timeout=PATIENCE)
    assert not thread.is_alive()
    assert got == ["picture", None]


def frames_through(gate: Gate, actions: list) -> list[int]:
    """Frames that have passed the gate when each action was taken, one at each look around while held."""
    passed, seen = 0, []

    def meanwhile() -> None:
        seen.append(passed)
        if actions:
            actions.pop(0)()

    while actions:
        gate.hold(meanwhile, every=0.0)
        passed += 1
    return seen


def test_a_step_lets_one_frame_through_and_clicks_do_not_pile_up():
    gate = Gate()
    gate.pause(True)

    def two_clicks() -> None:
        gate.step()
        gate.step()

    nothing = lambda: None  # noqa: E731
    seen = frames_through(gate, [nothing, gate.step, nothing, two_clicks, nothing, nothing, lambda: gate.pause(False)])
    assert seen == [0, 0, 1, 1, 2, 2, 2]
    assert not gate.paused


def test_an_open_gate_holds_nobody_and_a_step_closes_it():
    gate = Gate()
    looked: list[int] = []
    gate.hold(lambda: looked.append(1))
    gate.step()
    gate.hold(lambda: looked.append(1))
    assert looked == [] and gate.paused


def test_a_browser_is_served_once_for_each_change_and_only_its_last_view():
    requests = Requests()
    assert requests.next() is None
    for x in range(500):
        requests.look(camera(1, x))
    assert requests.next().position[0] == 499
    assert requests.next() is None
    requests.outdate()
    requests.outdate()
    assert requests.next().position[0] == 499
    assert requests.next() is None


def test_each_browser_is_served_in_its_own_mode():
    requests = Requests()
    requests.look(camera(1, mode="splats"))
    requests.look(camera(2, mode="depth"))
    assert requests.shows("splats") and requests.shows("depth") and not requests.shows("colour")
    assert requests.next(but="splats").mode == "depth"
    assert requests.next(but="splats") is None
    requests.look(camera(1, mode="colour"))
    assert requests.next(but="splats").client == 1
    assert not requests.shows("splats")


def test_browsers_take_turns_and_those_that_left_are_forgotten():
    requests = Requests()
    for client in (1, 2, 3):
        requests.look(camera(client))
    first = requests.next().client
    requests.look(camera(first))  # moves on and on
    assert [first, requests.next().client, requests.next().client, requests.next().client] == [1, 2, 3, 1]
    requests.outdate()
    requests.leave(2)
    assert len(requests) == 2
    assert {requests.next().client, requests.next().client} == {1, 3}
    assert requests.next() is None


def test_browsers_beyond_the_limit_are_left_out_until_one_goes():
    requests = Requests()
    for client in range(MAX_BROWSERS + 5):
        requests.look(camera(client))
    assert len(requests) == MAX_BROWSERS
    requests.look(camera(MAX_BROWSERS))
    assert len(requests) == MAX_BROWSERS
    requests.look(camera(3, x=1.0))  # one that is known may move
    requests.leave(0)
    requests.look(camera(MAX_BROWSERS))
    asked = [requests.next().client for _ in range(MAX_BROWSERS)]
    assert sorted(asked) == list(range(1, MAX_BROWSERS + 1))
    assert requests.next() is None


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


def test_a_charge_of_other_threads_counts_and_nothing_is_earned_while_the_mapper_is_held():
    clock = Clock()
    limit = CostLimit(0.1, clock)
    clock.now += 10.0
    limit.charge(1.5)  # 0.5 s more than there is
    with limit.suspended():
        clock.now += 1000.0
    clock.now += 4.9
    assert not limit.allows()
    clock.now += 0.2
    assert limit.allows()


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

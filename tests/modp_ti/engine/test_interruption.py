"""The first Ctrl-C is noted, the second is Python's own; while the map is not touched the first ends the waiting."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest

from modp_ti.engine.interruption import Interruption, RunStopped


def press() -> None:
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(100):  # Python calls the handler between two instructions
        pass


@pytest.fixture(autouse=True)
def as_in_a_terminal() -> Iterator[None]:
    """Where the tests run in a shell's background, Ctrl-C is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_the_first_is_noted_until_the_step_is_done_and_the_second_stops_at_once() -> None:
    said: list[str] = []
    with Interruption(lambda: said.append("stopping")) as stop:
        stop.begin()
        stop.check()
        press()
        assert (stop.asked, said) == (True, ["stopping"])
        with pytest.raises(RunStopped):
            stop.check()
        with pytest.raises(RunStopped), stop.waiting():
            pytest.fail("nothing is waited for any more")
        with pytest.raises(KeyboardInterrupt):
            press()


def test_it_ends_the_waiting_for_a_frame() -> None:
    with Interruption(lambda: pytest.fail("there is no step to be done")) as stop:
        stop.begin()
        with pytest.raises(RunStopped), stop.waiting():
            press()
            pytest.fail("it goes on waiting")
        with pytest.raises(RunStopped):
            stop.check()


def test_before_there_is_a_map_ctrl_c_interrupts_as_usual() -> None:
    with Interruption(lambda: pytest.fail("there is no step to be done")) as stop:
        with pytest.raises(KeyboardInterrupt):
            press()
        assert not stop.asked


def test_afterwards_it_is_what_it_was() -> None:
    with Interruption(lambda: None) as stop:
        pass
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with pytest.raises(KeyboardInterrupt):
        press()
    assert not stop.asked


@pytest.mark.parametrize("taken", [signal.SIG_IGN, lambda *_: None])
def test_it_is_left_to_whoever_has_it_already(taken: Any) -> None:
    signal.signal(signal.SIGINT, taken)
    with Interruption(lambda: pytest.fail("not ours")) as stop:
        press()
        assert signal.getsignal(signal.SIGINT) is taken
        stop.check()
    assert signal.getsignal(signal.SIGINT) is taken

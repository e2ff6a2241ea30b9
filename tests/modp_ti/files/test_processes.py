"""SIGTERM and SIGHUP are as Ctrl-C: the first is noted, a second stops at once, and what is ignored stays ignored."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from modp_ti.engine.interruption import Interruption
from modp_ti.files import processes
from modp_ti.files.processes import EndingSignals, RecordingInterrupt, exit_code

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}


def send(number: int) -> None:
    signal.raise_signal(number)
    for _ in range(100):  # Python calls the handler between two instructions
        pass


@pytest.fixture(autouse=True)
def as_in_a_terminal() -> Iterator[None]:
    defaults = dict.fromkeys(CODES, signal.SIG_DFL) | {signal.SIGINT: signal.default_int_handler}
    before = {number: signal.signal(number, handler) for number, handler in defaults.items()}
    yield
    assert all(signal.getsignal(number) is handler for number, handler in defaults.items())
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("second", CODES)
@pytest.mark.parametrize("first", CODES)
def test_the_first_is_noted_and_a_second_stops_at_once(
    first: signal.Signals, second: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "SAME_HANGUP", 0.0)
    signals = EndingSignals()
    with Interruption(lambda: None) as stop:
        stop.begin()
        send(first)
        assert stop.asked and exit_code() == CODES[first]
        with pytest.raises(KeyboardInterrupt):
            send(second)
        assert exit_code() == CODES[second]
    with pytest.raises(KeyboardInterrupt):
        send(second)
    signals.give_back()


def test_one_hang_up_counts_once_though_it_comes_twice() -> None:
    """Bash and the system each send SIGHUP to a run whose terminal closes."""
    with Interruption(lambda: None) as stop:
        recording = RecordingInterrupt(lambda: True)
        stop.begin()
        send(signal.SIGHUP)
        send(signal.SIGHUP)
        stop.check()
        send(signal.SIGTERM)
        assert stop.asked
        send(signal.SIGHUP)
        recording.give_back()


@pytest.mark.parametrize("number", CODES)
def test_a_recording_ends_first_and_one_that_has_ended_leaves_the_signal_to_the_run(number: int) -> None:
    going_on = [True]
    with Interruption(lambda: None) as stop:
        stop.begin()
        recording = RecordingInterrupt(lambda: bool(going_on) and going_on.pop())
        send(number)
        assert not going_on and not stop.asked
        recording.give_back()
        ended = RecordingInterrupt(lambda: False)
        send(number) if number != signal.SIGHUP else send(signal.SIGTERM)
        assert stop.asked
        ended.give_back()


def test_what_is_ignored_stays_ignored() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with Interruption(lambda: None) as stop:
        recording = RecordingInterrupt(lambda: pytest.fail("nohup"))
        stop.begin()
        send(signal.SIGHUP)
        assert not stop.asked
        recording.give_back()
    assert signal.signal(signal.SIGHUP, signal.SIG_DFL) is signal.SIG_IGN

"""Processes that the program starts, and the terminal."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from modp_ti.engine.interruption import Interruption
from modp_ti.files import processes
from modp_ti.files.errors import InputError
from modp_ti.files.processes import EndingSignals, RecordingInterrupt, exit_code
from modp_ti.files.terminal import CleanConsole, require_text, shown
from modp_ti.inputs.sources.image_folder import ImageFolder
from modp_ti.outputs.progress import ProgressLine

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


HOSTILE = "\x1b]0;title\x07\x9b31m\udcff\u202e[red]x[/red] :smile: Bäume.jpg"


def test_what_cannot_be_seen_is_escaped_and_all_else_stays() -> None:
    assert shown("Bäume\t[red]x\n") == "Bäume\t[red]x\n"
    cleaned = shown(HOSTILE)
    assert cleaned.isprintable() and cleaned.endswith("[red]x[/red] :smile: Bäume.jpg")
    assert shown(cleaned) == cleaned
    cleaned.encode("utf-8")


def test_an_image_whose_name_is_no_text_is_refused_when_the_folder_is_opened(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes())
    ImageFolder(tmp_path, 30.0)
    (tmp_path / "a.png").rename(os.fsdecode(os.fsencode(tmp_path) + b"/b\xff.png"))
    with pytest.raises(InputError) as refused:
        ImageFolder(tmp_path, 30.0)
    str(refused.value).encode("utf-8")
    require_text("Bäume")


def command(scene: Path, tail: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """`modp-ti check SCENE` in a shell of its own."""
    call = f'{sys.executable} -m modp_ti.commands.app check "$1" {tail}'
    env = {**os.environ, **variables}
    return subprocess.run(["sh", "-c", call, "sh", scene], env=env, capture_output=True, text=True, check=False)


@pytest.mark.slow
@pytest.mark.parametrize("tail", ["--json > /dev/full", "--json >&-"])
def test_a_result_that_cannot_be_written_is_an_error_of_one_line(tmp_path: Path, tail: str) -> None:
    done = command(tmp_path / "none.yaml", tail)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and "Traceback" not in done.stderr


@pytest.mark.slow
def test_a_locale_of_ascii_reads_and_prints_any_name(tmp_path: Path) -> None:
    locale = {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C"}
    (tmp_path / "Bäume.yaml").write_text("source: {path: Wälder}\n")
    done = command(tmp_path / "Bäume.yaml", "", **locale)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "Bäume.yaml" in done.stdout + done.stderr


@pytest.mark.slow
def test_lines_of_native_libraries_stay_off_the_terminal_and_those_of_python_do_not() -> None:
    program = (
        "import os, sys; from modp_ti.files.terminal import own_terminal, quiet_libraries\n"
        "own_terminal()\n"
        "with quiet_libraries(), quiet_libraries():\n"
        "    os.write(2, b'native'); print('python', file=sys.stderr)\n"
        "os.write(2, b'after')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert done.stderr == b"python\nafter"


def test_a_console_shows_names_as_they_are() -> None:
    console = CleanConsole()
    console.file = io.StringIO()
    line = ProgressLine(console)
    line.note(HOSTILE)
    text = console.file.getvalue()
    assert "[red]x[/re" in text and "\x1b]" not in text and "\x9b" not in text
    text.encode("utf-8")

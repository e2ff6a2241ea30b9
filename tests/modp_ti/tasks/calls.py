"""Calls for the tests of engines: their processes import them from here."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

from modp_ti.files.errors import InputError
from modp_ti.tasks import Report


def double(number: int, report: Report) -> int:
    report(f"doubling {number}")
    return 2 * number


def reject(report: Report) -> None:
    raise InputError("the input is\nof no use")


def stumble(report: Report) -> None:
    raise ZeroDivisionError("of all things")


def die(times: int, folder: Path, report: Report) -> int:
    """Kill this process as often as told; then return the number of the attempt."""
    attempt = 1 + len(list(folder.iterdir()))
    (folder / str(attempt)).touch()
    if attempt <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return attempt


def occupy(folder: Path, name: str, report: Report) -> int:
    """Return how many calls were at work in the folder at once, this one included, in a tenth of a second."""
    mine = folder / name
    mine.touch()
    most = 0
    for _ in range(20):
        most = max(most, len(list(folder.iterdir())))
        time.sleep(0.005)
    mine.unlink()
    return most


def wait_for_ctrl_c(file: Path, report: Report) -> Any:
    """Wait; when interrupted, write what has been done so far to the file."""
    try:
        file.with_suffix(".begun").touch()
        while True:
            time.sleep(0.01)
    except KeyboardInterrupt:
        file.write_text("saved")
        raise


def rest(seconds: float, report: Report) -> None:
    time.sleep(seconds)

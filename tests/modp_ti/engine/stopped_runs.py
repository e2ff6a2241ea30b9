"""Runs in this process that are stopped on their way, at an event that does not depend on the clock."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from modp_ti.engine import stages
from modp_ti.engine.resume import discard, load_resumed
from modp_ti.engine.session import run_scene
from modp_ti.engine.stream import Observer


class Killed(BaseException):
    """Ends a run in this process as SIGKILL would: nothing is saved on the way out."""


class Stopper(Observer):
    """Calls `act` after a number of events of a stage: "mapping", "refining", or "evaluating the saved map"."""

    def __init__(self, stage: str, count: int, act: Callable[[], object]) -> None:
        self._stage, self._left, self._act = stage, count, act

    def on_frame(self, *_: object) -> None:
        self.on_stage("mapping")

    def on_step(self, stage: str, *_: object) -> None:
        self.on_stage(stage)

    def on_stage(self, stage: str) -> None:
        self._left -= stage == self._stage
        if self._left == 0:
            self._left = -1
            self._act()


def kill() -> None:
    raise Killed


def press_ctrl_c() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def stopped_run(monkeypatch: pytest.MonkeyPatch, start: Callable[[], object], *at: object) -> BaseException:
    """Start a run in this process whose observer is `Stopper(*at)`, and return what ends it."""
    with monkeypatch.context() as patched:
        patched.setattr(stages, "open_observer", lambda *_: Stopper(*at))  # pyright: ignore[reportArgumentType]
        with pytest.raises((Killed, KeyboardInterrupt)) as ended:
            start()
    return ended.value


def resumed_run(output: Path) -> Path:
    """Resume a run in this process."""
    config, snapshot = load_resumed(output, None, [])
    folder = run_scene(config, resumed=snapshot)
    discard(folder)
    return folder

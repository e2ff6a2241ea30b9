"""A plane that is filmed, of which the tests write recordings, and the opening of these."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from modp_ti.config.settings import SceneConfig
from modp_ti.inputs import posed_recording
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.replay import ReplayedTracker
from tests.samples.filmed import Filmed, View, film

Opened = Callable[..., ReplayedTracker]


@pytest.fixture(scope="session")
def filmed() -> Filmed:
    """Seven views of 320x240."""
    return film(7, (320, 240), [f"view{i}.png" for i in range(8, 15)])  # not in the order of the alphabet


@pytest.fixture
def views(filmed: Filmed) -> list[View]:
    return list(filmed.views)


@pytest.fixture
def opened() -> Iterator[Opened]:
    """Open a recording as a run does: `opened(path, kind, source settings, tracker settings...)`. It is closed."""
    trackers: list[ReplayedTracker] = []

    def opened(place: Path, kind: str, source: dict | None = None, **tracker: object) -> ReplayedTracker:
        settings = {"source": {"path": place, **(source or {})}, "tracker": {"kind": kind, **tracker}, "output": "out"}
        result = open_tracker(SceneConfig.model_validate(settings))
        assert isinstance(result, ReplayedTracker)
        trackers.append(result)
        return result

    yield opened
    for tracker in trackers:
        tracker.close()


@pytest.fixture
def untriangulated(monkeypatch: pytest.MonkeyPatch) -> None:
    """The poses alone are looked at: triangulation, which finds no points with wrong ones, would take seconds."""
    monkeypatch.setattr(posed_recording, "triangulated_frames", lambda _, frames, *__: frames)

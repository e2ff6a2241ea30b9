"""Opening of captures by their place and kind."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from modp_ti.config.settings import SceneConfig
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.replay import ReplayedTracker
from tests.samples.filmed import Filmed, View

Opened = Callable[..., ReplayedTracker]


@pytest.fixture
def views(filmed: Filmed) -> list[View]:
    return list(filmed.views)


@pytest.fixture
def opened() -> Opened:
    """Open a capture as a run does: `opened(path, kind, source settings, tracker settings...)`."""

    def opened(place: Path, kind: str, source: dict | None = None, **tracker: object) -> ReplayedTracker:
        settings = {"source": {"path": place, **(source or {})}, "tracker": {"kind": kind, **tracker}, "output": "out"}
        result = open_tracker(SceneConfig.model_validate(settings))
        assert isinstance(result, ReplayedTracker)
        return result

    return opened

"""Taichi on the CPU, and one small sequence for all tests of the demo room."""

from __future__ import annotations

import pytest
import taichi as ti

from fields.backend import initialise
from modp_ti.synthetic import SyntheticTracker, TrackerNoise
from modp_ti.synthetic.renderer import RoomRenderer


@pytest.fixture(autouse=True, scope="session")
def taichi_on_the_cpu() -> None:
    """Started only where no other test has: another start would take the fields of their fixtures away."""
    if ti.lang.impl.get_runtime().prog is None:
        initialise("cpu")


@pytest.fixture(scope="session")
def room(taichi_on_the_cpu: None) -> RoomRenderer:
    """The demo room with a coarse light map, as no test here looks at its shadows."""
    return RoomRenderer(texel=0.3)


@pytest.fixture(scope="session")
def perfect(room: RoomRenderer) -> SyntheticTracker:
    """160x120 frames of a tracker without errors."""
    return SyntheticTracker(width=160, height=120, frames=28, noise=TrackerNoise.none(), points=150, room=room)

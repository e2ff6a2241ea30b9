"""One small sequence for the tests of the demo room."""

from __future__ import annotations

import pytest

from modp_ti.inputs.synthetic import SyntheticTracker, TrackerNoise
from modp_ti.inputs.synthetic.renderer import RoomRenderer


@pytest.fixture(scope="module")
def room(taichi_on_the_cpu: None) -> RoomRenderer:
    """The demo room with a coarse light map, as no test here looks at its shadows."""
    return RoomRenderer(texel=0.3)


@pytest.fixture(scope="module")
def perfect(room: RoomRenderer) -> SyntheticTracker:
    """160x120 frames of a tracker without errors."""
    return SyntheticTracker(width=160, height=120, frames=28, noise=TrackerNoise.none(), points=150, room=room)

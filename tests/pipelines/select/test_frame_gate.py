"""Frames that cannot be right do not touch the map, and those that can be right do."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.se3 import exp_se3
from fields.runtime.backend import initialise
from pipelines.online import OnlineMapper
from pipelines.settings import GateSettings
from pipelines.state import save_state
from tests.pipelines.test_online import SETTINGS
from tests.pipelines.wall import frame

pytestmark = pytest.mark.slow

AWAY = exp_se3([0.9, -0.4, 0.7, 0.2, 0.4, 0.1])
LENGTH = 7


def walk(i: int) -> TrackedFrame:
    """Frame i of a walk with even steps: the wall's own path, as often as it takes."""
    shown = frame(i % LENGTH) if (i // LENGTH) % 2 == 0 else frame(LENGTH - 1 - i % LENGTH)
    return replace(shown, index=i)


@pytest.fixture(scope="module")
def mapper() -> OnlineMapper:
    """A map of the wall from twelve frames in order."""
    initialise("cpu")
    mapper = OnlineMapper(SETTINGS, 64, 48, seed=5)
    for i in range(12):
        mapper.process(walk(i))
    assert sum(mapper.gate.refused.values()) == 0
    return mapper


def refusal(mapper: OnlineMapper, candidate: TrackedFrame) -> str | None:
    """What the gate says, which is then as before."""
    state = json.loads(json.dumps(mapper.gate.state()))
    try:
        return mapper.gate.refuses(candidate, mapper.keyframes[-1], mapper.renderer, mapper.near)
    finally:
        mapper.gate.refused = dict.fromkeys(mapper.gate.refused, 0)
        mapper.gate.restore(state)


def test_the_next_frame_passes(mapper: OnlineMapper) -> None:
    assert refusal(mapper, walk(12)) is None


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_a_picture_of_nothing_is_blank(mapper: OnlineMapper, value: float) -> None:
    noise = np.random.default_rng(0).normal(0, 0.003, (48, 64, 3))
    image = np.clip(value + noise, 0, 1).astype(np.float32)
    assert refusal(mapper, replace(walk(12), image=image)) == "blank"


def test_what_a_mask_leaves_is_what_counts(mapper: OnlineMapper) -> None:
    mask = np.zeros((48, 64), dtype=bool)
    mask[:24] = True
    image = walk(12).image.copy()
    image[:24] = 0.2
    assert refusal(mapper, replace(walk(12), image=image, mask=mask)) == "blank"
    assert refusal(mapper, replace(walk(12), image=image, mask=~mask)) is None


def test_the_picture_of_the_frame_before_at_another_pose_is_repeated(mapper: OnlineMapper) -> None:
    assert refusal(mapper, replace(walk(12), image=walk(11).image)) == "repeated"
    still = replace(walk(11), index=12)
    assert refusal(mapper, still) is None  # the camera stands


def test_a_pose_that_jumps_while_the_picture_does_not_is_refused(mapper: OnlineMapper) -> None:
    assert refusal(mapper, replace(walk(12), T_camera_world=AWAY @ walk(12).T_camera_world)) == "jumped"


def test_a_camera_that_jumps_with_its_picture_passes(mapper: OnlineMapper) -> None:
    """From the one end of the path to the other: fast, but what it shows is what the map shows there."""
    mapper_settings = mapper.gate.settings
    mapper.gate.settings = GateSettings(jump=1.01, min_jump=1e-6)
    try:
        assert refusal(mapper, replace(frame(5), index=12)) is None
    finally:
        mapper.gate.settings = mapper_settings


def test_refused_frames_leave_the_map_and_the_chance_alone(mapper: OnlineMapper) -> None:
    before, frames, gate = save_state(mapper), mapper.frame_count, mapper.gate.state()
    try:
        report = mapper.process(replace(walk(12), image=np.zeros((48, 64, 3), np.float32)))
        after = save_state(mapper)
        assert (report.is_keyframe, report.psnr) == (False, None)
        assert after.numbers["random"] == before.numbers["random"]
        assert mapper.gate.refused == {"blank": 1, "repeated": 0, "jumped": 0}
        assert mapper.frame_count == frames + 1
        for name, array in before.arrays.items():
            if not name.startswith("tracked"):
                assert array.tobytes() == after.arrays[name].tobytes(), name
    finally:
        mapper.gate.restore(gate)

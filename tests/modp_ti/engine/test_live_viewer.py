"""`LiveViewer` as the observer of a run: it changes nothing, and nothing that befalls it stops the run."""

from __future__ import annotations

import time
from itertools import count
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.se3 import inverse_se3, quaternion_from_matrix
from fields.map.keyframes import KeyframeStore
from fields.runtime.backend import initialise
from modp_ti.config.settings import ViewSettings
from modp_ti.engine.live_viewer import PATIENCE, LiveViewer
from modp_ti.engine.mapper import Mapper
from modp_ti.outputs.viewer.handover import BrowserCamera
from modp_ti.outputs.viewer.modes import LEAST_SIDE, MODES
from pipelines.settings import MappingSettings

if TYPE_CHECKING:
    from tests.room import RoomRecording

SETTINGS = MappingSettings.model_validate({"optimise": {"steps": 3}, "densify": {"warm_up": 3}})
WINDOWS = [(640, 480), (300, 500), (1600, 200)]


class Visited(LiveViewer):
    """With a browser that looks from elsewhere, in another mode, with another window at every frame and step.

    shown: shape of each picture.
    """

    def __init__(self) -> None:
        super().__init__(ViewSettings(port=0), pytest.fail)
        self.numbers_limit.allows = self.pictures_limit.allows = lambda: True
        self.visits = 0
        self.shown: list[tuple[int, ...]] = []
        self.page.show_picture = lambda client, picture: self.shown.append(picture.shape)

    def _look_around(self) -> None:
        self.visits += 1
        store = self._mapper.pipeline.keyframes
        if len(store):
            T = inverse_se3(store[-1].T_camera_world)
            T[:3, 3] += 0.02 * self.visits * T[:3, 0]
            q = quaternion_from_matrix(T[:3, :3])
            window = WINDOWS[self.visits % len(WINDOWS)]
            mode = MODES[self.visits % len(MODES)]
            self.page.requests.look(BrowserCamera(1, q, T[:3, 3] * self.page.units, 0.9, *window, mode))
        super()._look_around()
        while self._updates.waiting is not None:  # else pictures would be left out
            time.sleep(0.001)


def mapped(frames: list[TrackedFrame], viewer: LiveViewer | None) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
    """The Gaussians and the trajectory of a map that the viewer looks on."""
    initialise("cpu")
    mapper = Mapper(frames[0].camera.width, frames[0].camera.height, SETTINGS)
    if viewer is None:
        for frame in frames:
            mapper.add(frame)
        mapper.refine(3)
    else:
        viewer.begin(mapper, len(frames))
        for frame in frames:
            viewer.on_frame(frame, mapper.add(frame))
        mapper.refine(3, progress=lambda step, psnr: viewer.on_step("refining", step, 3, psnr))
        viewer.close()
    return mapper.pipeline.gaussians.to_numpy(), mapper.trajectory()


@pytest.mark.slow
def test_a_map_that_is_looked_at_is_the_same_bit_for_bit(room_recording: RoomRecording):
    frames = room_recording.frames()[:5]
    alone, trajectory = mapped(frames, None)
    viewer = Visited()
    seen, seen_trajectory = mapped(frames, viewer)
    assert len(alone["position"]) > 50
    for name, values in alone.items():
        np.testing.assert_array_equal(seen[name], values, err_msg=name)
    np.testing.assert_array_equal(seen_trajectory, trajectory)
    assert viewer.visits == 8
    assert len(viewer.shown) >= 4  # none before the first keyframe, and none of splats
    assert set(viewer.shown) == {(60, 80, 3), (60, 36, 3), (LEAST_SIDE, 80, 3)}


@pytest.fixture
def viewer():
    """One of a map that is still empty."""
    said: list[str] = []
    now = count(0.0, 1.0)
    viewer = LiveViewer(ViewSettings(port=0), said.append, lambda: next(now))
    viewer.said = said
    pipeline = SimpleNamespace(keyframes=KeyframeStore(), gaussians=[])
    viewer.begin(SimpleNamespace(frames=[], pipeline=pipeline), 10)
    yield viewer
    viewer.close()


def visit(viewer: LiveViewer) -> None:
    viewer.page.requests.look(BrowserCamera(1, np.array([1.0, 0, 0, 0]), np.zeros(3), 1.0, 640, 480, "splats"))


def test_a_paused_run_whose_browser_has_gone_goes_on(viewer: LiveViewer):
    visit(viewer)
    viewer.on_step("refining", 1, 9, 30.0)
    viewer.page.requests.leave(1)
    viewer._gate.pause(True)
    viewer.on_step("refining", 2, 9, 30.0)  # would hold for ever
    assert not viewer._gate.paused
    assert viewer._clock() > PATIENCE
    assert viewer.waited > 0
    assert viewer.said == []


def test_a_paused_run_goes_on_where_the_browser_that_paused_it_has_gone(viewer: LiveViewer):
    visit(viewer)  # this one stays
    viewer._gate.pause(True, 2)
    viewer.on_step("refining", 1, 9, 30.0)  # would hold for ever
    assert not viewer._gate.paused
    assert viewer.said == []


def test_a_viewer_that_fails_says_so_once_and_lets_the_run_go_on(viewer: LiveViewer):
    visit(viewer)
    viewer._gate.pause(True)
    viewer.page.requests.outdate = lambda: 1 / 0
    for step in range(3):
        viewer.on_step("refining", step, 9, 30.0)
    assert viewer.said == ["the viewer has stopped, the run goes on: ZeroDivisionError: division by zero"]

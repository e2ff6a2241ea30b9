"""The demo's camera changes the colours as it says, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from modp_ti.config.settings import SourceSettings
from modp_ti.config.tracker_settings import SyntheticSettings
from modp_ti.files.errors import InputError
from modp_ti.inputs.synthetic import LightChange, SyntheticTracker, open_synthetic
from modp_ti.inputs.synthetic.renderer import RoomRenderer

pytestmark = pytest.mark.slow

SHAPE = {"width": 64, "height": 48, "select": slice(3), "points": 60, "seed": 3}


def test_frames_show_the_exposure_times_the_vignette_and_tracking_is_the_same(room: RoomRenderer) -> None:
    plain = list(SyntheticTracker(**SHAPE, room=room))
    tracker = SyntheticTracker(**SHAPE, room=room, light=LightChange(vignette=0.6))
    for before, after in zip(plain, tracker, strict=True):
        exposure = tracker.exposure(after.index)
        expected = (before.image @ exposure[:, :3].T + exposure[:, 3]) * after.vignette
        np.testing.assert_allclose(after.image, np.clip(expected, 0, 1), atol=1e-6)
        np.testing.assert_array_equal(after.points.xyz, before.points.xyz)
        np.testing.assert_array_equal(after.T_camera_world, before.T_camera_world)
        assert before.vignette is None


def test_the_vignette_takes_its_share_in_the_corners_and_nothing_in_the_middle() -> None:
    vignette = LightChange(vignette=0.6).corner_vignette(401, 301)
    assert vignette.shape == (301, 401, 3)
    assert vignette[150, 200] == pytest.approx(np.ones(3))
    for corner in (vignette[0, 0], vignette[-1, 0], vignette[0, -1], vignette[-1, -1]):
        assert corner == pytest.approx(0.4 * np.ones(3), abs=0.01)
    assert LightChange().corner_vignette(4, 4) is None


def test_the_exposure_wanders_by_the_deviations_that_it_is_given() -> None:
    light = LightChange(gain=0.3, white_balance=0.05, bias=0.02, drift=2.0)
    exposures = light.exposures(4000, np.random.default_rng(0))
    logs = np.log(np.diagonal(exposures[:, :, :3], axis1=1, axis2=2))
    assert logs.mean(axis=1).std() == pytest.approx(np.hypot(0.3, 0.05 / np.sqrt(3)), rel=0.1)
    assert (logs - logs.mean(axis=1, keepdims=True)).std() == pytest.approx(0.05 * np.sqrt(2 / 3), rel=0.1)
    assert exposures[:, :, 3].std() == pytest.approx(0.02, rel=0.1)
    # From frame to frame it moves little: correlated over two frames.
    assert np.diff(logs.mean(axis=1)).std() < 0.5 * logs.mean(axis=1).std()


def test_a_scene_file_sets_how_much_it_wanders() -> None:
    source = SourceSettings(scale=0.25, stop=6)
    still = open_synthetic(source, SyntheticSettings())
    wandering = open_synthetic(source, SyntheticSettings(exposure_change=1.0))
    np.testing.assert_array_equal(still.exposure(4), np.eye(3, 4))
    assert np.abs(wandering.exposure(4) - np.eye(3, 4)).max() > 0.02


@pytest.mark.parametrize("setting", [{"masks": "m"}, {"mask_colour": (0, 0, 0)}, {"vignette": "v.png"}])
def test_the_demo_refuses_masks_and_vignettes(setting: dict) -> None:
    with pytest.raises(InputError, match="the demo room has neither masks nor a vignette"):
        open_synthetic(SourceSettings.model_validate(setting), SyntheticSettings())

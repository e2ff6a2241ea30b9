"""Something walks past the wall while it is mapped. The wall without it is known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from fields.frames.tracked_frame import TrackedFrame
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from tests.pipelines import wall

FRAMES = 24
SETTINGS = {"optimise": {"steps": 10}, "densify": {"warm_up": 2}}

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("taichi_on_the_cpu")]


def still(i: int) -> TrackedFrame:
    """A frame of a camera that goes to the right and back, as far as that of `wall`."""
    there = wall.frame(round(3 - 3 * np.cos(2 * np.pi * i / FRAMES)))
    return replace(there, index=i, timestamp=i / 30, name=f"{i}")


def walker(i: int) -> np.ndarray:
    """Where a frame (48, 64) shows what walks: 14 pixels wide, 30 high, four pixels further in each frame."""
    shown = np.zeros((48, 64), dtype=bool)
    left = 4 * i - 14
    shown[12:42, max(left, 0) : max(left + 14, 0)] = True
    return shown


def walked(i: int) -> TrackedFrame:
    frame = still(i)
    image = frame.image.copy()
    image[walker(i)] = (0.95, 0.9, 0.1)
    return TrackedFrame(i, i / 30, f"{i}", image, frame.camera, frame.T_camera_world, frame.points)


@cache
def mapped(walks: bool, transients: bool) -> OnlineMapper:
    mapper = OnlineMapper(MappingSettings(**SETTINGS, transients=transients), 64, 48, seed=1)
    for i in range(FRAMES):
        mapper.process(walked(i) if walks else still(i))
    mapper.finish()
    return mapper


def psnr(mapper: OnlineMapper) -> float:
    """PSNR of the wall alone in the views in which something walks."""
    errors = []
    for view in mapper.keyframes:
        shown = np.clip(mapper.renderer.render(view.camera, view.T_camera_world, mapper.near).colour, 0, 1)
        errors.append(((shown - still(view.index).image) ** 2).mean())
    return float(-10 * np.log10(np.mean(errors)))


def test_what_walks_is_masked_and_leaves_the_map() -> None:
    mapper = mapped(walks=True, transients=True)
    masked = np.stack([view.rgba[..., 3] < 128 for view in mapper.keyframes])
    there = np.stack([walker(view.index) for view in mapper.keyframes])
    assert (masked & there).sum() > 0.6 * there.sum()
    assert (masked & there).sum() > 0.5 * masked.sum()
    assert psnr(mapper) > psnr(mapped(walks=True, transients=False)) + 2.0


def test_nothing_is_masked_where_nothing_moves() -> None:
    mapper = mapped(walks=False, transients=True)
    assert all(view.transient is None for view in mapper.keyframes)
    assert psnr(mapper) == psnr(mapped(walks=False, transients=False))


def test_a_restored_map_has_its_masks() -> None:
    mapper = mapped(walks=True, transients=True)
    again = OnlineMapper(MappingSettings(**SETTINGS, transients=True), 64, 48, seed=1)
    again.restore(mapper.state(), [walked(i) for i in range(FRAMES)])
    for old, new in zip(mapper.keyframes, again.keyframes, strict=True):
        np.testing.assert_array_equal(old.rgba, new.rgba)
        assert (old.transient is None) == (new.transient is None)

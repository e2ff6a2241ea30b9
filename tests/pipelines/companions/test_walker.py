"""Something walks past the wall while it is mapped. The wall without it is known."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from pipelines.state import restore_state, save_state
from tests.pipelines.mapped_wall import fresh_mapper
from tests.pipelines.wall import FRAMES, WALKED, still, walked, walker

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("taichi_on_the_cpu")]


@dataclass(frozen=True)
class Mapped:
    """A mapper, whose fields are gone when the next one is made, and the PSNR of its map."""

    mapper: OnlineMapper
    psnr: float

    @property
    def masked(self) -> np.ndarray:
        """Which pixels (N, 48, 64) of the keyframes have less than half of their weight."""
        return np.stack([view.rgba[..., 3] < 128 for view in self.mapper.keyframes])


@cache
def mapped(walks: bool, transients: bool) -> Mapped:
    mapper = fresh_mapper(MappingSettings(**WALKED, transients=transients))
    for i in range(FRAMES):
        mapper.process(walked(i) if walks else still(i))
    mapper.finish()
    return Mapped(mapper, psnr(mapper))


def psnr(mapper: OnlineMapper) -> float:
    """PSNR of the wall alone from where something was seen to walk."""
    errors = []
    for view in mapper.keyframes:
        shown = np.clip(mapper.renderer.render(view.camera, view.T_camera_world, mapper.near).colour, 0, 1)
        errors.append(((shown - still(view.index).image) ** 2).mean())
    return float(-10 * np.log10(np.mean(errors)))


def test_what_walks_is_masked_and_leaves_the_map() -> None:
    found = mapped(walks=True, transients=True)
    there = np.stack([walker(view.index) for view in found.mapper.keyframes])
    assert (found.masked & there).sum() > 0.6 * there.sum()
    assert (found.masked & there).sum() > 0.4 * found.masked.sum()
    assert found.psnr > mapped(walks=True, transients=False).psnr + 1.0


def test_nothing_is_masked_where_nothing_moves() -> None:
    found = mapped(walks=False, transients=True)
    assert all(view.transient is None for view in found.mapper.keyframes)
    assert found.psnr == mapped(walks=False, transients=False).psnr


def test_a_restored_map_has_its_masks() -> None:
    mapper = fresh_mapper(MappingSettings(**WALKED, transients=True))
    for i in range(FRAMES):
        mapper.process(walked(i))
    mapper.finish()
    state, views = save_state(mapper), list(mapper.keyframes)
    again = fresh_mapper(MappingSettings(**WALKED, transients=True))
    restore_state(again, state, [walked(i) for i in range(FRAMES)])
    assert any(view.transient is not None for view in views)
    for old, new in zip(views, again.keyframes, strict=True):
        np.testing.assert_array_equal(old.rgba, new.rgba)
        assert (old.transient is None) == (new.transient is None)

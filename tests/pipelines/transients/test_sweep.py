"""A person walks through the room while it is mapped. The room without the person is known."""

from __future__ import annotations

import numpy as np
import pytest

from fields.map.keyframes import KeyframeStore
from pipelines.online import OnlineMapper
from pipelines.transients.sweep import neighbours, place_of
from tests.pipelines.transients.walked_room import CAMERA, held_out, mapped, recording


def psnr(mapper: OnlineMapper) -> float:
    """PSNR of the held-out views of the empty room."""
    square = []
    for frame in held_out(recording().still):
        T = mapper.keyframes.corrected(frame.index, frame.T_camera_world)
        shown = np.clip(mapper.renderer.render(CAMERA, T, mapper.near).colour, 0, 1)
        square.append(((shown - frame.image) ** 2).mean())
    return float(np.mean(-10 * np.log10(square)))


@pytest.mark.slow
@pytest.mark.usefixtures("taichi_on_the_cpu")
def test_a_person_who_walks_is_masked_and_leaves_the_map() -> None:
    with_person = psnr(mapped(recording().walked, transients=False))
    mapper = mapped(recording().walked, transients=True)
    assert psnr(mapper) > with_person + 1.0
    masked = np.stack([view.rgba[..., 3] < 128 for view in mapper.keyframes])
    there = np.stack([recording().person[view.index] for view in mapper.keyframes])
    assert (masked & there).sum() > 0.5 * there.sum()
    assert (masked & there).sum() > 0.5 * masked.sum()


@pytest.mark.slow
@pytest.mark.usefixtures("taichi_on_the_cpu")
def test_nothing_is_masked_in_a_still_room() -> None:
    mapper = mapped(recording().still, transients=True)
    assert all(view.transient is None for view in mapper.keyframes)


def test_neighbours_are_other_keyframes_near_and_far() -> None:
    for count in (1, 2, 9, 40, 200):
        for place in range(count):
            found = neighbours(place, count)
            assert len(set(found)) == len(found) <= 36
            assert all(0 <= other < count and abs(other - place) > 1 for other in found)
    far = neighbours(0, 200)
    assert np.diff(far).max() <= 13 and far[-1] >= 187


def test_a_frame_between_keyframes_has_the_place_of_the_next() -> None:
    store = KeyframeStore()
    for frame in recording().still[::10]:
        store.append(frame)
    assert [place_of(store.selected, index) for index in (0, 5, 10, 39)] == [0, 1, 1, 4]

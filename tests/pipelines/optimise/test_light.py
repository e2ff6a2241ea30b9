"""The change of light that switches the estimation of exposures on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fields.frames.tracked_frame import TrackedFrame
from fields.map.keyframes import KeyframeStore
from pipelines.optimise.exposure import CHANGED, light_changes
from tests.pipelines.wall import CAMERA, frame


def brightened(i: int, gain: float) -> TrackedFrame:
    f = frame(i)
    return replace(f, image=np.clip(gain * f.image, 0, 1).astype(np.float32))


def store_of(frames: list[TrackedFrame]) -> KeyframeStore:
    store = KeyframeStore()
    for each in frames:
        store.append(each)
    return store


def test_a_wall_in_constant_light_does_not_change() -> None:
    for last in range(1, 7):
        assert not light_changes(store_of([frame(i) for i in range(last + 1)]))


@pytest.mark.parametrize("gain", [0.5, 0.8, 1.2])
def test_a_brighter_or_darker_image_is_a_change(gain: float) -> None:
    assert light_changes(store_of([frame(0), frame(1), brightened(2, gain)]))


def test_the_light_of_an_earlier_place_does_not_count() -> None:
    store = store_of([frame(0), frame(1), brightened(2, 0.5)])
    store[2].begins_place = True
    assert not light_changes(store)
    store.append(brightened(3, 0.5))
    assert not light_changes(store)
    store.append(frame(4))
    assert light_changes(store)


def test_a_slow_drift_adds_up_over_several_keyframes() -> None:
    step = np.exp(0.4 * CHANGED)
    assert not light_changes(store_of([frame(0), brightened(1, step)]))
    assert light_changes(store_of([brightened(i, step**i) for i in range(6)]))


def test_a_thing_that_hides_a_third_of_the_points_is_no_change() -> None:
    hidden = frame(1)
    image = hidden.image.copy()
    image[:, : CAMERA.width // 3] = 0.9
    assert not light_changes(store_of([frame(0), replace(hidden, image=image)]))


def test_a_vignette_is_no_change_where_it_is_known() -> None:
    x = np.linspace(-1, 1, CAMERA.width)
    light = np.repeat(np.repeat((0.75 + 0.25 * x)[None, :, None], CAMERA.height, axis=0), 3, axis=2).astype(np.float32)
    known = [replace(f, image=f.image * light, vignette=light) for f in (frame(0), frame(6))]
    assert not light_changes(store_of(known))


def test_too_few_points_say_nothing() -> None:
    def few(f: TrackedFrame) -> TrackedFrame:
        p = f.points
        return replace(f, points=replace(p, xyz=p.xyz[:10], pixels=p.pixels[:10], ids=p.ids[:10]))

    assert not light_changes(store_of([few(frame(0)), few(brightened(1, 0.5))]))

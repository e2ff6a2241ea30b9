"""A recording with `source.realtime` arrives at the times of its time stamps. The clock is made up."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from modp_ti.inputs.opening import open_source
from modp_ti.inputs.source_settings import SourceSettings
from modp_ti.inputs.sources import ImageFolder
from modp_ti.inputs.sources.paced import Pace


class Clock:
    """Advances only while somebody waits or works."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now

    def wait(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """120 images whose grey value is their number."""
    made = tmp_path_factory.mktemp("images")
    for i in range(120):
        cv2.imwrite(str(made / f"{i:03d}.png"), np.full((12, 16, 3), i, np.uint8))
    return made


def paced(folder: Path, fps: float) -> tuple[ImageFolder, Clock]:
    clock, images = Clock(), ImageFolder(folder, fps)
    images.pace = Pace(clock, clock.wait)
    return images, clock


def test_images_arrive_at_the_times_of_their_stamps(folder):
    source, clock = paced(folder, fps=10)
    assert source.recording
    for i, name in enumerate(source.arriving(0, None, 1)):
        assert name == f"{i:03d}.png"
        assert clock.now == pytest.approx(1000.0 + 0.1 * i), "the first at once"
        assert source.recording == (i < 119)
        assert source.arrived(name) == pytest.approx(clock.now)
        clock.now += 0.06
    assert source.arrivals.arrived == 120 and source.arrivals.thinned == 0
    assert source.arrivals.newest == pytest.approx(1011.9)
    assert source.notes == [f"{folder} is played at the pace of its time stamps"]


def test_start_stop_and_step_select_as_without_a_clock(folder):
    source, clock = paced(folder, fps=10)
    names = []
    for name in source.arriving(5, 100, 3):
        names.append(name)
        assert clock.now == pytest.approx(1000.0 + 0.3 * (len(names) - 1))
    assert names == list(ImageFolder(folder).selected(5, 100, 3))
    assert source.read(names[1])[0, 0, 0] == 8


def test_what_a_slow_tracker_cannot_take_is_thinned_evenly(folder):
    source, clock = paced(folder, fps=30)
    names = []
    for name in source.arriving(0, None, 1):
        names.append(int(name[:3]))
        clock.now += 0.06
    assert set(np.diff(names)) == {1, 2} and np.diff(names)[8:].mean() > 1.8
    assert len(names) + source.arrivals.thinned == source.arrivals.arrived == 120
    assert source.notes[-1].startswith(f"{120 - len(names)} of 120 frames of ")


def test_a_second_reader_gets_the_same_images_at_once_and_then_goes_on(folder):
    source, clock = paced(folder, fps=30)
    first = source.arriving(0, None, 1)
    taken = []
    for _ in range(20):
        taken.append(next(first))
        clock.now += 0.06
    now = clock.now
    second = source.arriving(0, None, 1)
    assert [next(second) for _ in range(20)] == taken
    assert clock.now == now
    rest = list(second)
    assert rest[-1] == "119.png" and not set(rest) & set(taken)
    assert list(source.arriving(0, None, 1)) == taken + rest


def test_finish_ends_it_after_what_has_arrived(folder):
    source, clock = paced(folder, fps=10)
    arriving = source.arriving(0, None, 1)
    next(arriving)
    clock.now += 0.35
    assert next(arriving) == "001.png"
    source.finish()
    assert list(arriving) == ["002.png", "003.png"]


def test_the_setting_opens_it_with_the_camera_and_the_scale(folder):
    source = open_source(SourceSettings(path=folder, realtime=True, scale=0.5, intrinsics={"fx": 15.0}))
    assert isinstance(source.pace, Pace)
    assert (source.intrinsics.camera.fx, source.scale, source.frame_size) == (15.0, 0.5, (16, 12))

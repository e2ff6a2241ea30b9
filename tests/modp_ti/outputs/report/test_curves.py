"""The numbers behind the curves, computed another way."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modp_ti.outputs.report.plots import binned, frame_rate, shifts_and_turns
from modp_ti.outputs.report.record import FrameNote


def notes(durations: list[float]) -> list[FrameNote]:
    return [FrameNote(i, False, True, float(sum(durations[: i + 1])), 0, None) for i in range(len(durations))]


def test_the_frame_rate_is_the_inverse_of_the_mean_duration_of_the_last_frames() -> None:
    durations = [0.0, 3.0, 1.0, 0.25, 0.25, 2.0, 0.5, 0.125]
    rate = frame_rate(notes(durations), 3)
    assert np.isnan(rate[:2]).all()
    for i in range(2, 8):
        assert rate[i] == pytest.approx(1 / np.mean(durations[i - 2 : i + 1]))


def test_of_fewer_frames_than_its_window_the_rate_is_that_of_all() -> None:
    rate = frame_rate(notes([1.0, 3.0]), 5)
    assert np.isnan(rate[0]) and rate[1] == pytest.approx(0.5)
    assert frame_rate(notes([0.25]), 5) == pytest.approx([4.0])


def test_few_values_are_left_alone_and_many_become_means_of_neighbours() -> None:
    x, y = np.arange(1.0, 5.0), np.array([4.0, np.nan, 2.0, 7.0])
    np.testing.assert_array_equal(binned(x, y, 10), ([1, 3, 4], [4, 2, 7]))
    x = np.arange(1000.0)
    at, mean = binned(x, 2 * x + 1, 10)
    np.testing.assert_allclose(at, np.arange(10) * 100 + 49.5)
    np.testing.assert_allclose(mean, 2 * at + 1)


def test_shifts_and_turns_are_those_of_the_cameras() -> None:
    rng = np.random.default_rng(3)
    before, after, shifts, turns = [], [], [], []
    for degrees in (0.0, 1e-5, 0.02, 3.0, 90.0, 180.0):
        R, turn = Rotation.random(random_state=rng), Rotation.from_rotvec([0, np.radians(degrees), 0])
        centre, shift = rng.normal(size=3), rng.normal(size=3)
        for poses, rotation, place in ((before, R, centre), (after, turn * R, centre + shift)):
            T = np.eye(4)
            T[:3, :3] = rotation.as_matrix()
            T[:3, 3] = -T[:3, :3] @ place
            poses.append(T)
        shifts.append(np.linalg.norm(shift))
        turns.append(degrees)
    found = shifts_and_turns(before, after)
    np.testing.assert_allclose(found[0], shifts, rtol=1e-9)
    np.testing.assert_allclose(found[1], turns, rtol=1e-6, atol=1e-7)

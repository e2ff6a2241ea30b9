"""Images that are called by their times are told by them; other names are left alone."""

from __future__ import annotations

import numpy as np
import pytest

from modp_ti.inputs.sources.image_folder import times_of_names


def test_nanoseconds_microseconds_milliseconds_and_seconds_are_told_apart():
    euroc = ["1403636579763555584.png", "1403636579813555456.png"]
    np.testing.assert_allclose(times_of_names(euroc), [1403636579.763555584, 1403636579.813555456], atol=3e-7)
    tum = ["rgb/1305031453.359684.png", "rgb/1305031453.391690.png"]
    assert times_of_names(tum).tolist() == [1305031453.359684, 1305031453.391690]
    assert np.diff(times_of_names(["1403636579763555", "1403636579813555"])) == pytest.approx(0.05, abs=1e-6)
    assert np.diff(times_of_names(["1403636579763", "1403636579813"])) == pytest.approx(0.05, abs=1e-6)


@pytest.mark.parametrize(
    "names",
    [
        ["frame000000.jpg", "frame000001.jpg"],
        ["0000000000.png", "0000000001.png"],  # KITTI counts with ten digits
        ["0000000000000000000.png", "0000000000000000001.png"],
        ["1403636579763555584.png", "0001.png"],
        ["1403636579763555584.png", "a/1403636579763555584.png"],  # not rising
        ["1403636579763.png", "1403636579763555584.png"],
    ],
)
def test_other_names_are_no_times(names):
    assert times_of_names(names) is None

from __future__ import annotations

import numpy as np
import pytest

from fields.frames.pose_correction import PoseCorrection


@pytest.mark.parametrize(
    ("index", "T"),
    [(3, np.eye(4)), (np.int32(3), np.eye(4)[None]), ([3], np.eye(4).tolist()), (np.array([3]), np.eye(4, dtype="f4"))],
)
def test_one_frame_may_be_given_plainly(index: object, T: object) -> None:
    correction = PoseCorrection(index, T)
    assert correction.index.tolist() == [3] and correction.index.dtype == np.int64
    assert correction.T_camera_world.shape == (1, 4, 4) and correction.T_camera_world.dtype == np.float64


@pytest.mark.parametrize(
    "given",
    [
        (3.5, np.eye(4)),
        ([], np.zeros((0, 4, 4))),
        ([1, 1], [np.eye(4)] * 2),
        (-1, np.eye(4)),
        (1, np.full((4, 4), np.nan)),
        ([1, 2], np.eye(4)),
        (1, np.eye(4), [2], [[0.0, 0.0, np.inf]]),
        (1, np.eye(4), [2], []),
    ],
)
def test_corrections_that_do_not_fit_together_are_refused_in_one_line(given: tuple) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        PoseCorrection(*given)

from __future__ import annotations

import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera
from fields.map.covisibility import SeenPoints, covisibility

CAMERA = PinholeCamera(10.0, 10.0, 10.0, 10.0, 20, 20)  # sees |x| < z and |y| < z


def view(xyz: list[list[float]], x: float = 0.0) -> SeenPoints:
    """A camera at (x, 0, 0) with these tracked points."""
    T = np.eye(4)
    T[0, 3] = -x
    return SeenPoints(CAMERA, T, np.array(xyz, dtype=np.float64).reshape(-1, 3))


def test_covisibility_is_the_shared_part() -> None:
    # Both see the two in the middle; each has one that the other does not see.
    a = view([[0, 0, 2], [0.5, 0, 2], [-1.9, 0, 2]])
    b = view([[0, 0, 2], [0.5, 0, 2], [2.9, 0, 2]], x=1.0)
    assert a.count(b.xyz) == b.count(a.xyz) == 2
    assert covisibility(a, b) == pytest.approx(2 / (2 + 1 + 1))


def test_points_beyond_the_farthest_are_not_seen() -> None:
    a = view([[0, 0, 2]])
    assert a.count(np.array([[0, 0, 2.0], [0, 0, 2.5], [0, 0, -1.0], [5, 0, 2]])) == 1


def test_a_view_covers_itself_and_nothing_covers_no_points() -> None:
    a = view([[0, 0, 2], [0.5, 0, 2]])
    assert covisibility(a, a) == 1.0
    assert covisibility(a, view([])) == 0.1

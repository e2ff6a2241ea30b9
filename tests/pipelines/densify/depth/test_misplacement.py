from __future__ import annotations

import numpy as np

from pipelines.densify.depth.estimate import misplacement
from tests.pipelines.densify.test_growth import sideways, view


def test_a_misplacement_is_the_motion_of_the_pixel_in_the_views_that_see_it() -> None:
    v = view()
    pixels, depth, deviation = np.array([[80.5, 60.5], [158.5, 60.5]]), np.array([5.0, 5.0]), np.array([0.2, 0.2])
    others = [sideways(v, 0.5), sideways(v, 1.0)]
    moved = misplacement(v, others, pixels, depth, deviation)
    # A sideways camera sees a point at depth z at x - f b / z.
    expected = [100.0 * b * (1 / 5.0 - 1 / (5.0 * np.exp(0.2))) for b in (0.5, 1.0)]
    np.testing.assert_allclose(moved, np.sqrt(np.mean(np.square(expected))), rtol=1e-6)
    np.testing.assert_allclose(misplacement(v, [v], pixels, depth, deviation), 0.0, atol=1e-9)


def test_what_no_other_view_sees_is_misplaced_without_bound() -> None:
    v = view()
    pixels, depth, deviation = np.array([[2.5, 60.5]]), np.array([5.0]), np.array([0.2])
    assert np.isinf(misplacement(v, [], pixels, depth, deviation)).all()
    assert np.isinf(misplacement(v, [sideways(v, 1.0)], pixels, depth, deviation)).all()

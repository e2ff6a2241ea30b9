"""On the GPU, views of a place apart leave the Gaussians of other places as they do on the CPU."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.pipelines.two_walls import shares, two_walls


def test_views_of_a_place_leave_the_gaussians_of_others(on_both: Callable) -> None:
    cpu, gpu = on_both(lambda: shares(two_walls(), [2, 3]))
    assert gpu[0] == gpu[2] == 0.0
    assert gpu == pytest.approx(cpu, abs=0.02)

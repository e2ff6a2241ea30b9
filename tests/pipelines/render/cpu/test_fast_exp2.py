from __future__ import annotations

import numpy as np
import pytest

from fields.runtime.engine import ti
from tests.pipelines.render.cpu.exp2_kernels import powers


@pytest.mark.parametrize(("real", "tolerance"), [(ti.f32, 4e-7), (ti.f64, 2e-14)])
def test_it_is_the_power_of_two(real: object, tolerance: float) -> None:
    dtype = np.float32 if real == ti.f32 else np.float64
    x = np.concatenate([np.linspace(-124, 0, 200_001), -np.logspace(-9, 1, 1000)]).astype(dtype)
    expected = np.exp2(x.astype(np.float64))
    assert (np.abs(powers(x, real) / expected - 1) <= tolerance).all()


def test_far_below_it_vanishes() -> None:
    x = np.array([-130.0, -1e4, -1e30], dtype=np.float32)
    assert (powers(x, ti.f32) < 1e-37).all()

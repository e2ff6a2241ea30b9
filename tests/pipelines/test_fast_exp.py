from __future__ import annotations

import numpy as np
import pytest
import taichi as ti

from .exp_kernels import exponentials


@pytest.mark.parametrize(("real", "tolerance"), [(ti.f32, 3e-7), (ti.f64, 1e-14)])
def test_it_is_the_exponential_of_negative_numbers(real: object, tolerance: float) -> None:
    dtype = np.float32 if real == ti.f32 else np.float64
    x = np.concatenate([np.linspace(-80, 0, 200_001), -np.logspace(-9, 1, 1000)]).astype(dtype)
    expected = np.exp(x.astype(np.float64))
    # In units of the exponent's own rounding: float32 holds x * log2(e) to 4e-6 at -80.
    rounding = np.abs(x) * np.finfo(dtype).eps
    assert (np.abs(exponentials(x, real) / expected - 1) <= tolerance + rounding).all()


def test_far_below_it_vanishes() -> None:
    x = np.array([-90.0, -1e4, -1e30], dtype=np.float32)
    assert (exponentials(x, ti.f32) < 1e-37).all()

from __future__ import annotations

import numpy as np
import torch

from fields.runtime.async_readback import AsyncReadback


def test_later_writes_do_not_affect_a_readback() -> None:
    tensor = torch.tensor([1.0, 2.0])
    late = AsyncReadback(tensor)
    tensor += 1.0
    np.testing.assert_array_equal(late.numpy(), [1.0, 2.0])
    np.testing.assert_array_equal(late.numpy(), AsyncReadback(tensor - 1.0).numpy())


def test_sums_over_the_first_axis_are_exact() -> None:
    parts = torch.tensor([[1e8, 1.0], [1.0, 2.0], [1.0, 3.0]])  # 1e8 + 1 is no float32
    late = AsyncReadback(parts, summed=True)
    parts.zero_()
    np.testing.assert_array_equal(late.numpy(), [100_000_002.0, 6.0])

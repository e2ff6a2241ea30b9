"""Central finite differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

STEP = 1e-6


def central_differences(
    value: Callable[[dict[str, NDArray]], float], state: dict[str, NDArray], name: str
) -> NDArray[np.float64]:
    """d value / d state[name], entry by entry."""
    gradient = np.zeros(state[name].shape)
    for index in np.ndindex(*gradient.shape):
        values = []
        for sign in (1, -1):
            moved = {key: array.copy() for key, array in state.items()}
            moved[name][index] += sign * STEP
            values.append(value(moved))
        gradient[index] = (values[0] - values[1]) / (2 * STEP)
    return gradient

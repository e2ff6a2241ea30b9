"""`Moments`: Adam on small vectors of keyframes on the host, such as their poses and exposures."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray


class Moments:
    """Adam's moments by frame index.

    Args:
        shape: Shape S of what is optimised.

    Attributes:
        steps: Number of steps of each keyframe that has made any.
    """

    BETAS = (0.9, 0.999)

    def __init__(self, *shape: int) -> None:
        self._shape = shape
        self._first: dict[int, NDArray[np.float64]] = {}
        self._second: dict[int, NDArray[np.float64]] = {}
        self.steps: dict[int, int] = {}

    def step(self, index: int, gradient: NDArray[np.float64], rate: float) -> NDArray[np.float64]:
        """Take in the gradient (S) of a keyframe, and return what to subtract (S)."""
        beta1, beta2 = self.BETAS
        count = self.steps[index] = self.steps.get(index, 0) + 1
        none = np.zeros(self._shape)
        m = self._first[index] = beta1 * self._first.get(index, none) + (1 - beta1) * gradient
        v = self._second[index] = beta2 * self._second.get(index, none) + (1 - beta2) * gradient**2
        return rate * (m / (1 - beta1**count)) / (np.sqrt(v / (1 - beta2**count)) + 1e-15)

    def forget(self, index: int) -> None:
        """Forget the steps of a keyframe."""
        for table in (self._first, self._second, self.steps):
            table.pop(index, None)

    def state(self) -> dict[str, NDArray]:
        """Return the moments as arrays, for `restore`."""
        tables = {"m": self._first, "v": self._second}
        return {
            "index": np.array(list(self.steps), dtype=np.int64),
            "steps": np.array(list(self.steps.values()), dtype=np.int64),
            **{name: np.array(list(of.values())).reshape(-1, *self._shape) for name, of in tables.items()},
        }

    def restore(self, state: Mapping[str, NDArray]) -> None:
        """Restore the result of `state`.

        Raises:
            KeyError: If an array is missing.
            ValueError: If the arrays do not fit together, or a value is not finite.
        """
        index = state["index"].tolist()
        for name in ("m", "v"):
            if state[name].shape != (len(index), *self._shape) or not np.isfinite(state[name]).all():
                raise ValueError(f"the moments {name} are {state[name].shape} of {len(index)} keyframes, or not finite")
        self.steps = dict(zip(index, state["steps"].tolist(), strict=True))
        self._first, self._second = (dict(zip(index, np.array(state[name]), strict=True)) for name in ("m", "v"))

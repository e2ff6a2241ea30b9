"""`AsyncReadback`: an asynchronous copy of a small tensor from the device to the host."""

from typing import ClassVar

import numpy as np
import torch


class AsyncReadback:
    """A snapshot of a small tensor that is read later.

    The copy into pinned memory is queued behind the kernels launched so far. Later writes to the tensor do not affect
    it. Pinned memory and events are used again once they have been read, since making them anew took the host twice as
    long as the copy.

    Args:
        tensor: Tensor to copy.
        summed: Return the sum over the first axis, in float64.
    """

    _spare: ClassVar[dict[tuple[torch.dtype, torch.Size], list[tuple[torch.Tensor, torch.cuda.Event]]]] = {}

    def __init__(self, tensor: torch.Tensor, summed: bool = False) -> None:
        self._values: np.ndarray | None = None
        self._summed = summed
        if not tensor.is_cuda:
            self._values = self._reduced(tensor.numpy())
            return
        self._kind = (tensor.dtype, tensor.shape)
        spare = self._spare.setdefault(self._kind, [])
        if spare:
            self._host, self._event = spare.pop()
        else:
            self._host = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
            self._event = torch.cuda.Event()
        self._host.copy_(tensor, non_blocking=True)
        self._event.record()

    def numpy(self) -> np.ndarray:
        """Return the values. Waits for the copy if it has not finished."""
        if self._values is None:
            self._event.synchronize()
            self._values = self._reduced(self._host.numpy())
            self._spare[self._kind].append((self._host, self._event))
        return self._values

    def _reduced(self, values: np.ndarray) -> np.ndarray:
        return values.sum(axis=0, dtype=np.float64) if self._summed else values.copy()

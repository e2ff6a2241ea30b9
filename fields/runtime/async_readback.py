"""`AsyncReadback`: an asynchronous copy of a small tensor from the device to the host."""

import numpy as np
import torch

__all__ = ["AsyncReadback"]


class AsyncReadback:
    """A snapshot of a small tensor that is read later.

    The copy into pinned memory is queued behind the kernels launched so far. Later writes to the tensor do not affect
    it.

    Args:
        tensor: Tensor to copy.
    """

    def __init__(self, tensor: torch.Tensor) -> None:
        self._event: torch.cuda.Event | None = None
        if tensor.is_cuda:
            self._host = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
            self._host.copy_(tensor, non_blocking=True)
            self._event = torch.cuda.Event()
            self._event.record()
        else:
            self._host = tensor.clone()

    def numpy(self) -> np.ndarray:
        """Return the values. Waits for the copy if it has not finished."""
        if self._event is not None:
            self._event.synchronize()
            self._event = None
        return self._host.numpy()

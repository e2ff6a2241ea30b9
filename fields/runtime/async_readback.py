"""`AsyncReadback`: numbers on their way from the device to the host, which does not wait for them."""

import numpy as np
import torch

__all__ = ["AsyncReadback"]


class AsyncReadback:
    """A small tensor as it is now, read later: what is written into it afterwards is not seen.

    The copy into pinned memory is queued behind the kernels so far.
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
        """The numbers; waits where they have not arrived."""
        if self._event is not None:
            self._event.synchronize()
            self._event = None
        return self._host.numpy()

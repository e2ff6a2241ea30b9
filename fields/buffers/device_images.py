"""`DeviceImages`: a least-recently-used cache of host images on the device."""

import weakref
from collections import OrderedDict

import numpy as np
import torch

from fields.runtime.backend import torch_device


class DeviceImages:
    """Cache of device copies of keyframe images, which stay in host memory.

    An image is identified by its array object, whose contents must not change. When the array is garbage collected, its
    copy is dropped.

    Args:
        max_bytes: Capacity [bytes].

    Attributes:
        bytes: Bytes of all copies.
    """

    def __init__(self, max_bytes: float) -> None:
        self.max_bytes = max_bytes
        self.bytes = 0
        self._device = torch_device()
        self._copies: OrderedDict[int, tuple[weakref.ref, torch.Tensor]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._copies)

    def __contains__(self, image: np.ndarray) -> bool:
        return id(image) in self._copies

    def of(self, image: np.ndarray) -> torch.Tensor:
        """Return the device copy of a uint8 image, uploading it if necessary. Does not wait for the device."""
        key = id(image)
        if key in self._copies:
            self._copies.move_to_end(key)
            return self._copies[key][1]
        copy = self._upload(np.ascontiguousarray(image))
        self._copies[key] = weakref.ref(image, lambda _: self._drop(key)), copy
        self.bytes += copy.nbytes
        while self.bytes > self.max_bytes and len(self._copies) > 1:
            self._drop(next(iter(self._copies)))
        return copy

    def _upload(self, image: np.ndarray) -> torch.Tensor:
        host = torch.from_numpy(image)
        if self._device.type == "cpu":
            return host.clone()
        # A copy from memory that is not pinned would wait for the kernels launched before.
        pinned = torch.empty(host.shape, dtype=host.dtype, pin_memory=True)
        pinned.copy_(host)
        return pinned.to(self._device, non_blocking=True)

    def _drop(self, key: int) -> None:
        if key in self._copies:
            self.bytes -= self._copies.pop(key)[1].nbytes

"""The GPUs of this machine: its Vulkan devices, and whether the running one computes what the kernels need."""
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false

import ctypes
import functools
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fields.runtime.engine import ti

LIBRARY = "vulkan-1.dll" if sys.platform == "win32" else "libvulkan.so.1"
# VkPhysicalDeviceType. Software drivers are of type 4, a CPU.
INTEGRATED, DISCRETE = 1, 2
PREFERRED = (DISCRETE, INTEGRATED)
# Byte offsets in VkPhysicalDeviceProperties, and the number of a flag in VkPhysicalDeviceFeatures.
DEVICE_TYPE, DEVICE_NAME, NAME_SIZE = 16, 20, 256
SHADER_INT64 = 40


@dataclass(frozen=True)
class VulkanDevice:
    """A device with a Vulkan driver.

    Attributes:
        index: Its number in the loader's list.
        name: The driver's name for it.
        kind: Its VkPhysicalDeviceType.
        has_int64: Whether its kernels may use 64-bit integers.
    """

    index: int
    name: str
    kind: int
    has_int64: bool

    @property
    def is_gpu(self) -> bool:
        """Whether it is a GPU, and not a driver that computes on the CPU."""
        return self.kind in PREFERRED


class _InstanceCreateInfo(ctypes.Structure):
    _fields_ = [
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("flags", ctypes.c_uint32),
        ("application", ctypes.c_void_p),
        ("layer_count", ctypes.c_uint32),
        ("layers", ctypes.c_void_p),
        ("extension_count", ctypes.c_uint32),
        ("extensions", ctypes.c_void_p),
    ]


@functools.cache
def vulkan_devices() -> tuple[VulkanDevice, ...]:
    """Return all Vulkan devices in the loader's order; none where there is no loader or no driver."""
    try:
        vulkan = ctypes.CDLL(LIBRARY)
    except OSError:
        return ()
    instance = ctypes.c_void_p()
    if vulkan.vkCreateInstance(ctypes.byref(_InstanceCreateInfo(type=1)), None, ctypes.byref(instance)):
        return ()
    try:
        count = ctypes.c_uint32()
        vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
        handles = (ctypes.c_void_p * count.value)()
        if vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), handles):
            return ()
        return tuple(_describe(vulkan, index, handle) for index, handle in enumerate(handles[: count.value]))
    finally:
        vulkan.vkDestroyInstance(instance, None)


def _describe(vulkan: ctypes.CDLL, index: int, handle: int) -> VulkanDevice:
    device = ctypes.c_void_p(handle)
    # Both structures are smaller than these buffers: 824 and 220 bytes.
    properties, features = (ctypes.c_uint8 * 1024)(), (ctypes.c_uint32 * 64)()
    vulkan.vkGetPhysicalDeviceProperties(device, properties)
    vulkan.vkGetPhysicalDeviceFeatures(device, features)
    content = bytes(properties)
    name = content[DEVICE_NAME : DEVICE_NAME + NAME_SIZE].split(b"\0")[0].decode(errors="replace")
    kind = int.from_bytes(content[DEVICE_TYPE : DEVICE_TYPE + 4], sys.byteorder)
    return VulkanDevice(index, name, kind, bool(features[SHADER_INT64]))


def choose(devices: Sequence[VulkanDevice], asked: str | None = None) -> VulkanDevice | None:
    """Return the device with the asked index, else a discrete GPU before an integrated one, a software driver last.

    Returns None if there is no device.
    """
    for device in devices:
        if str(device.index) == asked:
            return device
    order = {kind: place for place, kind in enumerate(PREFERRED)}
    return min(devices, key=lambda device: order.get(device.kind, len(order)), default=None)


BLOCK = 64
VALUES = ti.types.ndarray(dtype=ti.i32, ndim=1)


@ti.kernel
def _sum_blocks(values: VALUES, sums: VALUES):
    ti.loop_config(block_dim=BLOCK)
    for i in range(values.shape[0]):
        shared = ti.simt.block.SharedArray((BLOCK,), ti.i32)
        shared[i & (BLOCK - 1)] = values[i]
        ti.simt.block.sync()
        total = ti.cast(0, ti.u64)
        for k in range(BLOCK):
            total += ti.cast(shared[k], ti.u64) << ti.cast(32, ti.u64)
        sums[i] = ti.cast(total >> ti.cast(32, ti.u64), ti.i32)


def computes_rightly() -> bool:
    """Return whether the running GPU adds up blocks by shared memory and 64-bit integers, as the kernels need.

    A driver without them refuses the kernel or computes something else.
    """
    values = np.arange(4 * BLOCK, dtype=np.int32)
    sums = np.zeros_like(values)
    try:
        _sum_blocks(values, sums)
    except Exception:  # the engines raise several kinds, and each means no
        return False
    return bool((sums == np.repeat(values.reshape(4, BLOCK).sum(axis=1), BLOCK)).all())

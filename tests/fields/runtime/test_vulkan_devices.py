from __future__ import annotations

import pytest

from fields.runtime.vulkan_devices import VulkanDevice, choose, vulkan_devices

SOFTWARE = VulkanDevice(0, "llvmpipe", 4, True)
INTEGRATED = VulkanDevice(1, "integrated", 1, True)
DISCRETE = VulkanDevice(2, "discrete", 2, True)
VIRTUAL = VulkanDevice(3, "virtual", 3, True)


def test_a_discrete_gpu_is_chosen_before_an_integrated_one_and_a_software_driver_last() -> None:
    assert choose([SOFTWARE, INTEGRATED, DISCRETE]) is DISCRETE
    assert choose([SOFTWARE, INTEGRATED]) is INTEGRATED
    assert choose([SOFTWARE]) is SOFTWARE
    assert choose([]) is None


def test_the_device_that_was_asked_for_is_chosen_if_it_exists() -> None:
    assert choose([SOFTWARE, INTEGRATED, DISCRETE], "0") is SOFTWARE
    assert choose([SOFTWARE, INTEGRATED, DISCRETE], "7") is DISCRETE
    assert choose([SOFTWARE, INTEGRATED, DISCRETE], "") is DISCRETE


def test_only_discrete_and_integrated_devices_are_gpus() -> None:
    assert [device.is_gpu for device in (SOFTWARE, INTEGRATED, DISCRETE, VIRTUAL)] == [False, True, True, False]


def test_the_loader_names_every_device() -> None:
    """Names and kinds come from fixed places of a structure, which would be garbage at any other place."""
    if not vulkan_devices():
        pytest.skip("no Vulkan driver here")
    for index, device in enumerate(vulkan_devices()):
        assert device.index == index
        assert device.name.isprintable() and len(device.name) > 2
        assert device.kind in range(5)
        # Mesa's software driver, which most machines that test have.
        assert ("llvmpipe" in device.name) <= (not device.is_gpu and device.has_int64)

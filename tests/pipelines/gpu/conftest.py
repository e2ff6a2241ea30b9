"""The GPU's kernels beside the CPU's: on CUDA where there is a device, else on a (software) Vulkan driver."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

from fields.runtime.backend import initialise

PROJECT = Path(__file__).resolve().parents[3]
PROBE = """
import sys
from fields.runtime.backend import initialise
for device in ("cuda", "vulkan"):
    try:
        print("starts", initialise(device))
        break
    except RuntimeError:
        pass
"""
T = TypeVar("T")


@pytest.fixture(scope="session")
def gpu() -> str:
    """The device that stands in for a GPU. Asked in a process of its own, which a broken driver may end."""
    probe = subprocess.run([sys.executable, "-c", PROBE], cwd=PROJECT, capture_output=True, text=True, check=False)
    found = [line.split()[1] for line in probe.stdout.splitlines() if line.startswith("starts ")]
    if not found:
        pytest.skip("neither CUDA nor Vulkan starts here")
    return found[0]


@pytest.fixture(scope="module")
def on_both(taichi_on_the_cpu: None, gpu: str) -> Callable[[Callable[[], T]], tuple[T, T]]:
    """Call a function with Taichi on the CPU and then on the GPU, where it stays; both results, in NumPy."""

    def call(function: Callable[[], T]) -> tuple[T, T]:
        initialise("cpu")
        first = function()
        initialise(gpu)
        return first, function()

    return call

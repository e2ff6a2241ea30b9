from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fields.runtime.engine import TAICHI, engine
from fields.runtime.gpus import vulkan_devices
from tests.patience import PATIENCE

pytestmark = pytest.mark.slow

PROJECT = Path(__file__).resolve().parents[3]


def has_cuda_driver() -> bool:
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


def python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """In a process of its own: starting Taichi takes the fields of every other test away."""
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=PROJECT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )


@pytest.mark.skipif(has_cuda_driver(), reason="there is a CUDA driver")
def test_cuda_is_refused_where_there_is_none_with_the_way_out_named() -> None:
    result = python("from fields.runtime.backend import initialise; initialise('cuda')")
    assert result.returncode != 0
    assert result.stderr.splitlines()[-1].startswith("RuntimeError: device: cuda was asked for")
    assert "cpu or auto" in result.stderr.splitlines()[-1]


@pytest.mark.parametrize("device", ["vulkan", "metal"])
def test_a_device_that_does_not_start_is_refused_in_one_line_with_the_way_out_named(device: str) -> None:
    if device == "metal" and sys.platform == "darwin":
        pytest.skip("macOS has Metal")
    code = f"from fields.runtime.backend import initialise; initialise('{device}')"
    result = python(code, VK_ICD_FILENAMES="/no/driver", VK_DRIVER_FILES="/no/driver")
    assert result.returncode != 0
    assert result.stderr.splitlines()[-1].startswith(f"RuntimeError: device: {device} was asked for, but ")
    assert "cpu or auto" in result.stderr.splitlines()[-1]


def pretending(
    kind: int, device: str, has_int64: bool = True, computes: bool = True
) -> subprocess.CompletedProcess[str]:
    """Start on a device where the first Vulkan driver of this machine claims to be of a kind."""
    wrong = "" if computes else "backend.computes_rightly = lambda: False\n"
    return python(
        "from dataclasses import replace; from fields.runtime import backend\n"
        "first = backend.vulkan_devices()[0]\n"
        f"backend.vulkan_devices = lambda: (replace(first, kind={kind}, has_int64={has_int64}),)\n"
        f"{wrong}"
        f"started = backend.initialise('{device}'); print(started, backend.describe(started), sep='; ')"
    )


@pytest.mark.skipif(has_cuda_driver() or sys.platform == "darwin", reason="there is another GPU")
@pytest.mark.parametrize(("kind", "taken"), [(4, "cpu"), (1, "vulkan"), (2, "vulkan")])
def test_auto_takes_a_gpu_by_vulkan_and_no_software_driver(kind: int, taken: str) -> None:
    if not vulkan_devices():
        pytest.skip("no Vulkan driver here")
    said = pretending(kind, "auto").stdout.splitlines()[-1]
    assert said == ("cpu; CPU" if taken == "cpu" else f"vulkan; Vulkan ({vulkan_devices()[0].name})")


@pytest.mark.skipif(has_cuda_driver() or sys.platform == "darwin", reason="there is another GPU")
def test_a_driver_without_64_bit_integers_is_named_and_not_taken() -> None:
    if not vulkan_devices():
        pytest.skip("no Vulkan driver here")
    assert pretending(2, "auto", has_int64=False).stdout.splitlines()[-1] == "cpu; CPU"
    refused = pretending(2, "vulkan", has_int64=False).stderr.splitlines()[-1]
    assert f"{vulkan_devices()[0].name} has no 64-bit integers; use device: cpu or auto" in refused


@pytest.mark.skipif(has_cuda_driver() or sys.platform == "darwin", reason="there is another GPU")
def test_a_driver_that_computes_wrongly_is_named_and_not_taken() -> None:
    if not vulkan_devices():
        pytest.skip("no Vulkan driver here")
    assert pretending(2, "auto", computes=False).stdout.splitlines()[-1] == "cpu; CPU"
    refused = pretending(2, "vulkan", computes=False).stderr.splitlines()[-1]
    assert "does not compute what the kernels need; use device: cpu or auto" in refused


@pytest.mark.skipif(has_cuda_driver() or sys.platform == "darwin", reason="there is another GPU")
def test_auto_takes_the_cpu_where_no_driver_starts() -> None:
    code = "from fields.runtime.backend import initialise; print(initialise('auto'))"
    said = python(code, VK_ICD_FILENAMES="/no/driver", VK_DRIVER_FILES="/no/driver").stdout.split()
    assert said[-1] == "cpu"


def test_the_number_of_threads_is_taken() -> None:
    code = (
        "from fields.runtime.engine import configuration; from fields.runtime.backend import initialise;"
        "initialise('cpu', threads=1); print(configuration().cpu_max_num_threads)"
    )
    assert python(code).stdout.split()[-1] == "1"


@pytest.mark.skipif(engine() is not TAICHI, reason="only Taichi asks")
def test_starting_taichi_asks_no_server_for_its_latest_version() -> None:
    code = (
        "from taichi import _version_check\n"
        "_version_check.try_check_version = lambda: print('asked', flush=True)\n"
        "from fields.runtime.backend import initialise; print(initialise('cpu'))"
    )
    said = python(code).stdout.split()
    assert said[-1] == "cpu" and "asked" not in said


def test_arrays_made_before_a_start_do_not_free_those_made_after_it() -> None:
    code = """
from fields.runtime.backend import initialise
from fields.runtime.engine import dense_array, ti

old = []
for start in range(20):
    initialise("cpu")
    new = [dense_array(ti.i32, (256,)) for _ in range(8)]
    for array in new:
        array.fill(7)
    old.clear()
    more = [dense_array(ti.i32, (256,)) for _ in range(8)]
    assert all((array.to_numpy() == 7).all() for array in new)
    old = new + more
print("unharmed")
"""
    assert python(code).stdout.split()[-1:] == ["unharmed"]

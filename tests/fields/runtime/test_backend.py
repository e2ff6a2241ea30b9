from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path

import pytest

from fields.runtime.engine import TAICHI, engine
from tests.patience import PATIENCE

pytestmark = pytest.mark.slow

PROJECT = Path(__file__).resolve().parents[3]


def has_cuda_driver() -> bool:
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


def python(code: str) -> subprocess.CompletedProcess[str]:
    """In a process of its own: starting Taichi takes the fields of every other test away."""
    return subprocess.run(
        [sys.executable, "-c", code], cwd=PROJECT, capture_output=True, text=True, timeout=PATIENCE, check=False
    )


@pytest.mark.skipif(has_cuda_driver(), reason="there is a CUDA driver")
def test_cuda_is_refused_where_there_is_none_with_the_way_out_named() -> None:
    result = python("from fields.runtime.backend import initialise; initialise('cuda')")
    assert result.returncode != 0
    assert result.stderr.splitlines()[-1].startswith("RuntimeError: device: cuda was asked for")
    assert "cpu or auto" in result.stderr.splitlines()[-1]


@pytest.mark.skipif(has_cuda_driver(), reason="there is a CUDA driver")
def test_auto_takes_the_cpu_where_there_is_no_cuda() -> None:
    assert (
        python("from fields.runtime.backend import initialise; print(initialise('auto'))").stdout.split()[-1] == "cpu"
    )


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

"""Freed memory that the C library keeps goes back to the operating system."""

from __future__ import annotations

import ctypes
import subprocess
import sys

import pytest

from fields.runtime import heap

# 400 arrays of 100 kB, too small for pages of their own, below one that stays.
PROGRAM = """
import os
import numpy as np
from fields.runtime.heap import give_back_heap

def resident():
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

arrays = [np.ones(100_000, np.uint8) for _ in range(400)]
last = np.ones(100_000, np.uint8)
held = resident()
del arrays
freed = resident()
give_back_heap()
print(held - freed, freed - resident(), last.sum())
"""


@pytest.mark.skipif(sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="needs glibc")
def test_what_lies_below_something_that_stays_is_given_back() -> None:
    run = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    by_itself, given_back, kept = map(int, run.stdout.split())
    assert by_itself < 4e6 < 36e6 < given_back and kept == 100_000


def test_without_such_a_c_library_nothing_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(heap.ctypes, "CDLL", lambda _: object())
    heap.give_back_heap()

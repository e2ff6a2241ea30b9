"""Memory that is not needed goes back to the operating system."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path

import numpy as np
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


# 8 MB of a file, all of which are read.
MAPPED = """
import mmap, os, sys
import numpy as np
from fields.runtime.heap import give_back_pages

def resident():
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

with open(sys.argv[1], "rb") as file:
    array = np.frombuffer(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY), np.int64).reshape(-1, 4)[1:]
total = array.sum()
read = resident()
give_back_pages(array)
print(read - resident(), total == array.sum())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_what_was_read_of_a_mapped_file_is_given_back_and_can_be_read_again(tmp_path: Path) -> None:
    np.arange(1 << 20).tofile(tmp_path / "numbers")
    command = [sys.executable, "-c", MAPPED, str(tmp_path / "numbers")]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    given_back, equal = run.stdout.split()
    assert int(given_back) > 8e6 and equal == "True"


def test_an_array_in_memory_stays_as_it_is() -> None:
    array = np.arange(100_000)
    heap.give_back_pages(array[10:])
    assert array.tolist() == list(range(100_000))

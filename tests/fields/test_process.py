"""What the engine needs of the process around it, and the devices on which it starts."""

import ctypes
import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from fields.runtime.compiled_kernel import AsyncReadback
from fields.runtime.engine import TAICHI, engine
from fields.runtime.gpus import VulkanDevice, choose, vulkan_devices
from fields.runtime.process import NEEDED, why_too_narrow
from tests.patience import PATIENCE

# 400 arrays of 100 kB, too small for pages of their own, below one that stays.
PROGRAM = """
import os
import numpy as np
from fields.runtime.process import give_back_heap

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


# 8 MB of a file, all of which are read.
MAPPED = """
import mmap, os, sys
import numpy as np
from fields.runtime.process import give_back_pages

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


@pytest.mark.slow
@pytest.mark.parametrize("home", [None, "a file"])
def test_a_process_without_a_home_ends_well(tmp_path: Path, home: str | None) -> None:
    (tmp_path / "a file").touch()
    (tmp_path / "tmp").mkdir()
    environment = {**os.environ, "TMPDIR": str(tmp_path / "tmp"), "HOME": str(tmp_path / home) if home else ""}
    for name in ("XDG_CACHE_HOME", "MPLCONFIGDIR", *([] if home else ["HOME"])):
        environment.pop(name, None)
    program = "import modp_ti; print(modp_ti.initialise('cpu'))"
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False, timeout=PATIENCE
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "cpu\n", "")
    assert list((tmp_path / "tmp").iterdir()) == []


@pytest.mark.parametrize("limit", [1_500_000_000, NEEDED, resource.RLIM_INFINITY])
def test_a_narrow_address_space_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch, limit: int) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (limit, limit))
    why = why_too_narrow()
    assert (why is None) == (limit != 1_500_000_000)
    assert why is None or "\n" not in why


ROOT = Path(__file__).resolve().parents[2]
STARTS = """
import os, sys
from fields.runtime.process import threads_of_process
before = threads_of_process()
from fields.runtime.backend import initialise
initialise("cpu", int(sys.argv[1]) or None)
from fields.runtime.engine import ti

x = ti.field(ti.f32, 1 << 20)

@ti.kernel
def busy():
    for i in x:
        x[i] = ti.sin(x[i]) + 1.0

def worked(thread):
    return int(open(f"/proc/self/task/{thread}/schedstat").read().split()[0])

busy()
threads = sorted(threads_of_process() - before - {os.getpid()})
start = {thread: worked(thread) for thread in threads}
for _ in range(100):
    busy()
workers = sorted(threads, key=lambda thread: start[thread] - worked(thread))[: int(sys.argv[2])]
print([sorted(os.sched_getaffinity(worker)) for worker in sorted(workers)])
print(sorted(os.sched_getaffinity(0)))
"""


def affinities(folder: Path, threads: int, workers: int) -> tuple[list[list[int]], list[int]]:
    """Processors of the threads that worked most in a process with `threads` (0: the default), and of its first."""
    program = folder / "busy.py"
    program.write_text(STARTS)
    command = [sys.executable, program, str(threads), str(workers)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    environment.pop(engine().variable("cpu_max_num_threads"), None)  # which `--spread` sets
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    placed, first = done.stdout.splitlines()[-2:]
    return json.loads(placed), json.loads(first)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system does not place threads")
def test_as_many_workers_as_processors_have_one_each(tmp_path):
    processors = sorted(os.sched_getaffinity(0))
    placed, first = affinities(tmp_path, 0, len(processors))
    assert placed == [[processor] for processor in processors]
    assert first == processors


SOFTWARE = VulkanDevice(0, "llvmpipe", 4, True)
INTEGRATED = VulkanDevice(1, "integrated", 1, True)
DISCRETE = VulkanDevice(2, "discrete", 2, True)


def test_a_discrete_gpu_is_chosen_before_an_integrated_one_and_a_software_driver_last() -> None:
    assert choose([SOFTWARE, INTEGRATED, DISCRETE]) is DISCRETE
    assert choose([SOFTWARE, INTEGRATED]) is INTEGRATED
    assert choose([SOFTWARE]) is SOFTWARE
    assert choose([]) is None


def test_the_device_that_was_asked_for_is_chosen_if_it_exists() -> None:
    assert choose([SOFTWARE, INTEGRATED, DISCRETE], "0") is SOFTWARE
    assert choose([SOFTWARE, INTEGRATED, DISCRETE], "7") is DISCRETE
    assert choose([SOFTWARE, INTEGRATED, DISCRETE], "") is DISCRETE


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


def test_later_writes_do_not_affect_a_readback() -> None:
    tensor = torch.tensor([1.0, 2.0])
    late = AsyncReadback(tensor)
    tensor += 1.0
    np.testing.assert_array_equal(late.numpy(), [1.0, 2.0])
    np.testing.assert_array_equal(late.numpy(), AsyncReadback(tensor - 1.0).numpy())


pytestmark = pytest.mark.slow


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
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )


def test_a_device_that_does_not_start_is_refused_in_one_line_with_the_way_out_named() -> None:
    absent = ["vulkan", *(["metal"] if sys.platform != "darwin" else []), *([] if has_cuda_driver() else ["cuda"])]
    code = (
        "from fields.runtime.backend import initialise\n"
        f"for device in {absent}:\n"
        "    try: initialise(device)\n"
        "    except RuntimeError as error: print(error)"
    )
    said = python(code, VK_ICD_FILENAMES="/no/driver", VK_DRIVER_FILES="/no/driver").stdout.splitlines()
    for device, line in zip(absent, said[-len(absent) :], strict=True):
        assert line.startswith(f"device: {device} was asked for") and "cpu or auto" in line


@pytest.mark.skipif(has_cuda_driver() or sys.platform == "darwin", reason="there is another GPU")
def test_auto_takes_a_gpu_by_vulkan_and_no_software_driver_or_one_without_64_bit_integers() -> None:
    """The first Vulkan driver of this machine claims to be of one kind or another."""
    if not vulkan_devices():
        pytest.skip("no Vulkan driver here")
    name = vulkan_devices()[0].name
    code = (
        "from dataclasses import replace; from fields.runtime import backend\n"
        "first = backend.vulkan_devices()[0]\n"
        "def start(device, kind, has_int64=True):\n"
        "    backend.vulkan_devices = lambda: (replace(first, kind=kind, has_int64=has_int64),)\n"
        "    try: print(backend.describe(backend.initialise(device)))\n"
        "    except RuntimeError as error: print(error)\n"
        "for arguments in (('auto', 4), ('auto', 1), ('auto', 2), ('auto', 2, False), ('vulkan', 2, False)):\n"
        "    start(*arguments)"
    )
    *taken, refused = python(code).stdout.splitlines()[-5:]
    assert taken == ["CPU", f"Vulkan ({name})", f"Vulkan ({name})", "CPU"]
    assert f"{name} has no 64-bit integers; use device: cpu or auto" in refused


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

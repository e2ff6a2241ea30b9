"""Workers of the engine's CPU backend stay on processors of their own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fields.runtime.engine import engine

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system does not place threads"),
]

ROOT = Path(__file__).resolve().parents[3]
PROGRAM = """
import os, sys
from fields.runtime.workers import threads_of_process
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
    program.write_text(PROGRAM)
    command = [sys.executable, program, str(threads), str(workers)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    environment.pop(engine().variable("cpu_max_num_threads"), None)  # which `--spread` sets
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    placed, first = done.stdout.splitlines()[-2:]
    return json.loads(placed), json.loads(first)


def test_as_many_workers_as_processors_have_one_each(tmp_path):
    processors = sorted(os.sched_getaffinity(0))
    placed, first = affinities(tmp_path, 0, len(processors))
    assert placed == [[processor] for processor in processors]
    assert first == processors


def test_fewer_workers_than_processors_go_where_there_is_room(tmp_path):
    processors = sorted(os.sched_getaffinity(0))
    if len(processors) < 2:
        pytest.skip("one processor")
    placed, _ = affinities(tmp_path, 1, 1)
    assert placed == [processors]

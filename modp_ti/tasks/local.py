"""`LocalEngine`: calls in processes on this machine, as many at a time as its cores, GPU and memory allow."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from platform import node
from typing import Any, cast

from fields.runtime.parallel import available_cores
from modp_ti.files.child_environment import child_environment
from modp_ti.files.reading import available_memory
from modp_ti.tasks.engine import Ended, Engine, Running
from modp_ti.tasks.task import Answer, End, Resources, Work

__all__ = ["LocalEngine"]

# Time that a process gets to end after its answer, or when its pipe is closed [s].
PATIENCE = 10.0


class _Call:
    """A call that runs, its process and our end of its pipe."""

    def __init__(self, resources: Resources, process: subprocess.Popen[bytes], connection: Connection) -> None:
        self.resources = resources
        self.process = process
        self.connection = connection

    def receive(self) -> Any:
        """Return the next report or the `Answer`. A process that ends without one is lost."""
        try:
            return self.connection.recv()
        except (EOFError, OSError):
            return Answer(End.lost, error=f"its process ended ({self._cause()})")

    def stop(self) -> None:
        try:
            self.connection.send(None)
        except OSError:
            pass  # the process is gone: `receive` says so

    def close(self) -> None:
        """Close the pipe, which ends the process, and wait for it."""
        self.connection.close()
        try:
            self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def _cause(self) -> str:
        try:
            code = self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            return "it closed its pipe"
        if code >= 0:
            return f"exit code {code}"
        name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
        return f"{name}, perhaps for want of memory" if -code == signal.SIGKILL else name


class LocalEngine(Engine):
    """Runs calls on this machine.

    Args:
        jobs: Largest number of calls at a time; None for as many as the cores allow.
        logs: Folder for what the calls print, a file `NAME.log` each, which is appended to; None discards it.
    """

    def __init__(self, jobs: int | None = None, logs: Path | None = None) -> None:
        self._jobs = jobs
        self._logs = logs
        self._cores = float(available_cores())
        self._memory = available_memory()
        self._machine = node() or "this machine"
        self._waiting: deque[tuple[str, Work, Resources]] = deque()
        self._running: dict[str, _Call] = {}
        self._ended: list[Running | Ended] = []

    @property
    def machines(self) -> Sequence[float]:
        """The cores of this machine, or one number a job: its share of the cores."""
        return [self._cores] if self._jobs is None else [self._cores / self._jobs] * self._jobs

    def submit(self, name: str, work: Work, resources: Resources) -> None:
        self._waiting.append((name, work, resources))

    def events(self, wait: float) -> list[Running | Ended]:
        found, self._ended = self._ended, []
        while self._waiting and self._fits(self._waiting[0][2]):
            name, work, resources = self._waiting.popleft()
            self._running[name] = self._begin(name, work, resources)
            found.append(Running(name, self._machine))
        found += self._received(0.0 if found else wait)
        return found

    def stop(self) -> None:
        self._ended += [Ended(name, Answer(End.interrupted, error="not begun")) for name, _, _ in self._waiting]
        self._waiting.clear()
        for call in self._running.values():
            call.stop()

    def __exit__(self, *error: object) -> None:
        self._waiting.clear()
        for call in self._running.values():
            call.process.kill()
            call.close()
        self._running.clear()

    def _fits(self, wanted: Resources) -> bool:
        """Whether a call can begin. One that asks for more than the machine has runs alone."""
        taken = [call.resources for call in self._running.values()]
        if not taken:
            return True
        if self._jobs is not None and len(taken) >= self._jobs:
            return False
        all_of = [*taken, wanted]
        return (
            (self._jobs is not None or sum(each.cpus for each in all_of) <= self._cores)
            and sum(each.gpus for each in all_of) <= 1.0
            and sum(each.memory or 0 for each in all_of) <= self._memory
        )

    def _begin(self, name: str, work: Work, resources: Resources) -> _Call:
        ours, theirs = Pipe()
        with ExitStack() as held:
            held.enter_context(theirs)
            output: Any = subprocess.DEVNULL
            if self._logs is not None:
                self._logs.mkdir(parents=True, exist_ok=True)
                output = held.enter_context(open(self._logs / f"{name}.log", "ab", opener=_not_through_links))
            process = _started(theirs.fileno(), max(1, int(resources.cpus)), output)
        call = _Call(resources, process, cast(Connection, ours))
        try:
            ours.send(work)
        except OSError:
            pass  # the process is gone: `receive` says so
        return call

    def _received(self, seconds: float) -> list[Running | Ended]:
        found: list[Running | Ended] = []
        ready = wait_for([call.connection for call in self._running.values()], seconds) if self._running else []
        for name, call in list(self._running.items()):
            if call.connection not in ready:
                continue
            message = call.receive()
            if not isinstance(message, Answer):
                found.append(Running(name, self._machine, message))
                continue
            call.close()
            del self._running[name]
            found.append(Ended(name, message, self._machine))
        return found


def _not_through_links(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


def _started(descriptor: int, threads: int, output: Any) -> subprocess.Popen[bytes]:
    """Start the process of a call. A session of its own keeps Ctrl-C away: the engine decides what it means."""
    return subprocess.Popen(
        [sys.executable, "-c", "from modp_ti.tasks.child import main; main()", str(descriptor)],
        pass_fds=[descriptor],
        env=child_environment(threads),
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=output,
        start_new_session=True,
    )

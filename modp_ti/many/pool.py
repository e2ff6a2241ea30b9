"""`Pool`: carries out tasks with the resources that each asks for, and `LocalPool`, on this machine."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from platform import node
from typing import Any, Protocol

from fields.runtime.process import available_cores
from modp_ti.files.errors import InputError
from modp_ti.files.reading import available_memory
from modp_ti.many.task import End, TaskProcess

# Time between two looks at the running processes [s].
GLANCE = 0.05


@dataclass(frozen=True)
class Resources:
    """What a task asks of a machine.

    Attributes:
        cpus: Number of cores.
        gpus: Number of GPUs; 0.5 lets two tasks share one. A task with 0 must not use any.
        memory: Memory [bytes], None if it is not known.
    """

    cpus: float = 1.0
    gpus: float = 0.0
    memory: int | None = None


@dataclass(frozen=True)
class Running:
    """A task has begun or made progress, on this machine; `progress` is the last line of its log, or empty."""

    name: str
    machine: str
    progress: str = ""


@dataclass(frozen=True)
class Ended:
    """A task has ended. `error` is one line that says why it is not done; `machine` is empty if it is not known."""

    name: str
    end: End
    error: str = ""
    machine: str = ""


class Pool(AbstractContextManager["Pool"], Protocol):
    """Carries out tasks, each in a process of its own. Leaving the context ends those that still run."""

    @property
    def machines(self) -> Sequence[float]:
        """Number of cores of each machine that there is now."""
        ...

    def submit(self, name: str, settings: dict[str, Any], resources: Resources) -> None:
        """Queue a task. It begins when a machine has the resources; tasks begin roughly in the order of submission.

        Args:
            name: Name in the events of this task. No other task of this name may be queued or running.
            settings: Settings of the scene as plain data, see `TaskProcess`.
            resources: What it needs.
        """
        ...

    def events(self, wait: float) -> list[Running | Ended]:
        """Return what has happened since the last call, in order, waiting at most `wait` seconds for something."""
        ...

    def stop(self) -> None:
        """Have all tasks save what they have and end; queued ones do not begin. `events` reports each end."""
        ...


class LocalPool(Pool):
    """Tasks on this machine, as many at a time as its cores, GPU and memory allow.

    Args:
        logs: Folder for what the tasks print, a file `NAME.log` each, which is appended to.
        jobs: Largest number of tasks at a time; None for as many as the cores allow.
    """

    def __init__(self, logs: Path, jobs: int | None = None) -> None:
        self._logs = logs
        self._jobs = jobs
        self._cores = float(available_cores())
        self._memory = available_memory()
        self._machine = node() or "this machine"
        self._waiting: deque[tuple[str, dict[str, Any], Resources]] = deque()
        self._running: dict[str, tuple[TaskProcess, Resources]] = {}
        self._left_out: list[Running | Ended] = []

    @property
    def machines(self) -> Sequence[float]:
        """The cores of this machine, or one number a job: its share of the cores."""
        return [self._cores] if self._jobs is None else [self._cores / self._jobs] * self._jobs

    def submit(self, name: str, settings: dict[str, Any], resources: Resources) -> None:
        self._waiting.append((name, settings, resources))

    def events(self, wait: float) -> list[Running | Ended]:
        found, self._left_out = self._left_out, []
        while self._waiting and self._fits(self._waiting[0][2]):
            name, settings, resources = self._waiting.popleft()
            process = TaskProcess(settings, resources.cpus, self._logs / f"{name}.log")
            self._running[name] = process, resources
            found.append(Running(name, self._machine))
        until = time.monotonic() + wait
        while True:
            for name, (process, _) in list(self._running.items()):
                if (said := process.news()) != "":
                    found.append(Running(name, self._machine, said))
                if (end := process.end()) is not None:
                    del self._running[name]
                    process.close()
                    found.append(Ended(name, *end, self._machine))
            if found or time.monotonic() > until:
                return found
            time.sleep(GLANCE)

    def stop(self) -> None:
        self._left_out += [Ended(name, End.interrupted, "not begun") for name, _, _ in self._waiting]
        self._waiting.clear()
        for process, _ in self._running.values():
            process.stop()

    def __exit__(self, *error: object) -> None:
        for process, _ in self._running.values():
            process.close()

    def _fits(self, wanted: Resources) -> bool:
        """Whether a task can begin. One that asks for more than the machine has runs alone."""
        taken = [resources for _, resources in self._running.values()]
        all_of = [*taken, wanted]
        return not taken or (
            (sum(each.cpus for each in all_of) <= self._cores if self._jobs is None else len(taken) < self._jobs)
            and sum(each.gpus for each in all_of) <= 1.0
            and sum(each.memory or 0 for each in all_of) <= self._memory
        )


def open_pool(kind: str, logs: Path, address: str | None = None, jobs: int | None = None) -> Pool:
    """Open a pool.

    Args:
        kind: "local" for processes on this machine, "ray" for a Ray cluster.
        logs: Folder for what the tasks print, `NAME.log` for each.
        address: Address of the Ray cluster, see `RayPool`.
        jobs: Largest number of tasks at a time, for "local"; None for as many as the cores allow.

    Raises:
        InputError: If Ray is not installed or cannot be reached, or an option is of the other kind.
    """
    if kind == "local":
        if address is not None:
            raise InputError("--address is for --engine ray")
        return LocalPool(logs, jobs)
    if jobs is not None:
        raise InputError("--jobs is for --engine local: with ray, --cpus, --gpus and --memory say what fits a machine")
    from modp_ti.many.ray_pool import RayPool

    return RayPool(logs, address)

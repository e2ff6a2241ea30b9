"""`Pool`: carries out tasks with the resources that each asks for, on this machine or on a Ray cluster."""

from __future__ import annotations

import io
import os
import re
import secrets
import socket
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from platform import node
from typing import Any, Protocol

from fields.runtime.process import available_cores
from modp_ti.files.errors import InputError
from modp_ti.files.reading import available_memory
from modp_ti.many.task import PATIENCE, End, TaskProcess, log_end

# Time between two looks at the running processes [s].
GLANCE = 0.05
# Time between two looks at a process on a machine of Ray, and so between two reports to the machine of the command [s].
REPORT_EVERY = 1.0
# Longest wait for a cluster to answer [s].
CONNECT_WAIT = 10.0
# Longest wait for the board of reports, which are left out rather than waited for [s].
BOARD_WAIT = 5.0
# The end of a task's log that comes with its end [bytes].
LOG = 1 << 18


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


class _Board:
    """An actor on the command's machine, to which the tasks report and from which the pool reads."""

    def __init__(self) -> None:
        self._latest: dict[str, tuple[str, str]] = {}

    def put(self, name: str, machine: str, progress: str) -> None:
        self._latest[name] = machine, progress or self._latest.get(name, ("", ""))[1]

    def take(self) -> dict[str, tuple[str, str]]:
        """Return machine and last report of each task that has reported since the last time."""
        latest, self._latest = self._latest, {}
        return latest


def _carry_out(name: str, settings: dict[str, Any], cpus: float, board: Any) -> tuple[End, str, str, bytes]:
    """Carry out a task from a worker of Ray. Return its end, one line on it, the machine's name, and the log's end."""
    machine = node()
    board.put.remote(name, machine, "")
    with tempfile.TemporaryDirectory(prefix="modp-ti-") as folder:
        log = Path(folder) / "log"
        process = TaskProcess(settings, cpus, log)
        try:
            while (end := process.end(REPORT_EVERY)) is None:
                if (said := process.news()) != "":
                    board.put.remote(name, machine, said)
        except KeyboardInterrupt:  # cancelled
            process.stop()
            end = process.end(PATIENCE) or (End.interrupted, "interrupted")
        finally:
            process.close()
        return end[0], end[1], machine, log_end(log, LOG)


class RayPool(Pool):
    """Tasks on a Ray cluster, on whose machines the same MODP-Ti must be installed.

    Args:
        logs: Folder for the end of what the tasks print, a file `NAME.log` each, which is appended to.
        address: Address of the cluster; None for the one that `RAY_ADDRESS` names, or for a new one of this process
            alone, which answers only to those who have its random token. No other cluster is ever joined.

    Raises:
        InputError: If Ray is not installed or the cluster cannot be reached.
    """

    def __init__(self, logs: Path, address: str | None = None) -> None:
        address = address or os.environ.get("RAY_ADDRESS") or "local"
        if address == "local":
            # Ray listens at all addresses of the machine, and asks for this token unless it is told not to.
            os.environ.pop("RAY_AUTH_MODE", None)
            os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        try:
            import ray  # pyright: ignore[reportMissingImports] - an extra
        except ImportError:
            raise InputError("--engine ray needs Ray: pip install 'modp-ti[cluster]'") from None
        from ray.util.scheduling_strategies import (  # pyright: ignore[reportMissingImports]
            NodeAffinitySchedulingStrategy,
        )

        _require_reachable(address)
        self._logs = logs
        self._ray = ray
        # Ray prints a paragraph for every lost worker. Standard output is for results, and the events say it shortly.
        self._held = ExitStack()
        self._held.enter_context(redirect_stdout(io.StringIO()))
        self._held.callback(ray.shutdown)
        try:
            ray.init(address, log_to_driver=False, logging_level="error", include_dashboard=False)
            if address == "local" and os.environ.get("RAY_AUTH_MODE") != "token":
                raise RuntimeError("this version of it would let anybody in")
            here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
        except Exception as error:  # ConnectionError, RuntimeError, ValueError, and those of gRPC
            self._held.close()
            reason, where = " ".join(str(error).split())[:200], address.replace("local", "this machine")
            raise InputError(f"Ray at {where} cannot be used: {reason}; start it, or correct --address") from None
        board = ray.remote(_Board).options(num_cpus=0, max_restarts=-1, scheduling_strategy=here)
        self._board: Any = board.remote()
        self._remote: Any = ray.remote(max_retries=0)(_carry_out)  # the batch counts the attempts
        self._names: dict[Any, str] = {}  # of the tasks that have not ended, by the reference to their end

    @property
    def machines(self) -> Sequence[float]:
        nodes = (each["Resources"].get("CPU", 0.0) for each in self._ray.nodes() if each["Alive"])
        return [cores for cores in nodes if cores]

    def submit(self, name: str, settings: dict[str, Any], resources: Resources) -> None:
        wanted = {"num_cpus": resources.cpus, "num_gpus": resources.gpus, "memory": resources.memory}
        remote = self._remote.options(name=name, scheduling_strategy="SPREAD", **wanted)
        self._names[remote.remote(name, settings, resources.cpus, self._board)] = name

    def events(self, wait: float) -> list[Running | Ended]:
        names = list(self._names)
        ready = self._ray.wait(names, num_returns=len(names), timeout=wait)[0] if names else []
        found: list[Running | Ended] = list(self._reported())
        return found + [self._ended(self._names.pop(reference), reference) for reference in ready]

    def stop(self) -> None:
        for reference in self._names:
            self._ray.cancel(reference)

    def __exit__(self, *error: object) -> None:
        with suppress(self._ray.exceptions.RayError):
            for reference in self._names:
                self._ray.cancel(reference, force=True)
        self._held.close()

    def _reported(self) -> list[Running]:
        try:
            latest = self._ray.get(self._board.take.remote(), timeout=BOARD_WAIT)
        except self._ray.exceptions.RayError:
            return []
        running = set(self._names.values())
        return [Running(name, *said) for name, said in latest.items() if name in running]

    def _ended(self, name: str, reference: Any) -> Ended:
        errors = self._ray.exceptions
        try:
            end, error, machine, log = self._ray.get(reference)
        except errors.TaskCancelledError:
            return Ended(name, End.interrupted, "interrupted")
        except errors.OutOfMemoryError:
            return Ended(name, End.lost, "its machine ran out of memory, and Ray ended its process (--memory)")
        except errors.RayTaskError as error:  # before it began, such as another version of the program there
            return Ended(name, End.fault, f"Ray could not begin it ({error.cause!r})")
        except errors.RayError as error:
            lost = "its process or its machine was lost"
            return Ended(name, End.lost, f"{lost} ({type(error).__name__}: {' '.join(str(error).split())[:200]})")
        self._logs.mkdir(parents=True, exist_ok=True)
        with open(self._logs / f"{name}.log", "ab") as file:
            file.write(log)
        return Ended(name, end, error, machine)


def _require_reachable(address: str) -> None:
    """Raise InputError if nothing answers at `HOST:PORT`. Ray itself would try for minutes."""
    found = re.fullmatch(r"(?:ray://)?\[?([^/\]]+)\]?:([0-9]{1,5})", address)
    if found is None:
        return
    try:
        socket.create_connection((found[1], int(found[2])), CONNECT_WAIT).close()
    except (OSError, OverflowError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or error
        raise InputError(f"Ray at {address} cannot be reached: {reason}; start it, or correct --address") from None


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
    return RayPool(logs, address)

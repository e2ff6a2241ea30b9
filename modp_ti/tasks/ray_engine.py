"""`RayEngine`: calls as tasks of a Ray cluster, each in a worker process that ends with it."""

from __future__ import annotations

import io
import os
import platform
import re
import secrets
import socket
import time
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stdout, suppress
from typing import Any

from modp_ti.files.errors import InputError
from modp_ti.tasks.engine import Ended, Engine, Running
from modp_ti.tasks.task import Answer, End, Resources, Work, perform

__all__ = ["RayEngine"]

# Least time between two reports of a call, since each is a message to the driver's machine [s].
REPORT_EVERY = 1.0
# Longest wait for a cluster to answer [s].
CONNECT_WAIT = 10.0
# Longest wait for the board of reports, which are left out rather than waited for [s].
BOARD_WAIT = 5.0


class _Board:
    """An actor on the driver's machine, to which the calls report and from which the engine reads."""

    def __init__(self) -> None:
        self._latest: dict[str, tuple[str, Any]] = {}

    def put(self, name: str, machine: str, report: Any) -> None:
        self._latest[name] = (machine, report)

    def take(self) -> dict[str, tuple[str, Any]]:
        """Return machine and last report of each call that has reported since the last time."""
        latest, self._latest = self._latest, {}
        return latest


def _perform(name: str, work: Work, board: Any) -> tuple[Answer, str]:
    """Make a call in a worker process of Ray. Return its end and the name of the machine."""
    machine, told = platform.node(), 0.0
    board.put.remote(name, machine, None)

    def report(content: Any) -> None:
        nonlocal told
        if time.monotonic() - told >= REPORT_EVERY:
            told = time.monotonic()
            board.put.remote(name, machine, content)

    return perform(work, report), machine


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


class RayEngine(Engine):
    """Runs calls on a Ray cluster, on whose machines the same MODP-Ti must be installed.

    Args:
        address: Address of the cluster; None for the one that `RAY_ADDRESS` names, or for a new one of this process
            alone, which answers only to those who have its random token. No other cluster is ever joined.

    Raises:
        InputError: If Ray is not installed or the cluster cannot be reached.
    """

    def __init__(self, address: str | None = None) -> None:
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
        self._ray = ray
        # Ray prints a paragraph for every lost worker. Standard output is for results, and the events tell it shortly.
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
        # A worker runs one call and ends: a process has room for one map. `run_tasks` counts the attempts.
        self._remote: Any = ray.remote(max_calls=1, max_retries=0)(_perform)
        self._names: dict[Any, str] = {}  # of the calls that have not ended, by the reference to their answer

    @property
    def machines(self) -> Sequence[float]:
        nodes = (node["Resources"].get("CPU", 0.0) for node in self._ray.nodes() if node["Alive"])
        return [cores for cores in nodes if cores]

    def submit(self, name: str, work: Work, resources: Resources) -> None:
        wanted = {"num_cpus": resources.cpus, "num_gpus": resources.gpus, "memory": resources.memory}
        remote = self._remote.options(name=name, scheduling_strategy="SPREAD", **wanted)
        self._names[remote.remote(name, work, self._board)] = name

    def events(self, wait: float) -> list[Running | Ended]:
        names = list(self._names)
        ready = self._ray.wait(names, num_returns=len(names), timeout=wait)[0] if names else []
        found: list[Running | Ended] = list(self._reported())
        return found + [Ended(self._names.pop(reference), *self._answer(reference)) for reference in ready]

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
        return [Running(name, *told) for name, told in latest.items() if name in running]

    def _answer(self, reference: Any) -> tuple[Answer, str]:
        """Return the end of a call, and its machine where that is known."""
        exceptions = self._ray.exceptions
        try:
            return self._ray.get(reference)
        except exceptions.TaskCancelledError:
            return Answer(End.interrupted, error="interrupted"), ""
        except exceptions.OutOfMemoryError:
            return Answer(End.lost, error="its machine ran out of memory, and Ray ended its process (--memory)"), ""
        except exceptions.WorkerCrashedError:
            return Answer(End.lost, error="its process ended"), ""
        except (exceptions.NodeDiedError, exceptions.ObjectLostError):
            return Answer(End.lost, error="its machine was lost"), ""
        except exceptions.RayTaskError as error:  # before the call began, such as another version of the program there
            return Answer(End.fault, error=f"Ray could not begin it ({error.cause!r})", traceback=str(error)), ""
        except exceptions.RayError as error:
            return Answer(End.lost, error=f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"), ""

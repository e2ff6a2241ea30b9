"""`Engine`: what carries out the calls of tasks, and the events by which it tells about them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from modp_ti.files.errors import InputError
from modp_ti.tasks.task import Answer, Resources, Work

__all__ = ["Ended", "Engine", "Running", "open_engine"]


@dataclass(frozen=True)
class Running:
    """A call has begun or has reported.

    Attributes:
        name: Name of the call.
        machine: Name of the machine that it runs on.
        report: What it has reported last, None if nothing yet.
    """

    name: str
    machine: str
    report: Any = None


@dataclass(frozen=True)
class Ended:
    """A call has ended.

    Attributes:
        name: Name of the call.
        answer: How it ended.
        machine: Name of the machine that it ran on, "" if it did not begin or was lost.
    """

    name: str
    answer: Answer
    machine: str = ""


class Engine(AbstractContextManager["Engine"], Protocol):
    """Carries out calls, each in a process of its own. Leaving the context ends those that still run."""

    @property
    def machines(self) -> Sequence[float]:
        """Number of cores of each machine that there is now."""
        ...

    def submit(self, name: str, work: Work, resources: Resources) -> None:
        """Queue a call. It begins when a machine has the resources; calls begin roughly in the order of submission.

        Args:
            name: Name in the events of this call. No other call of this name may be queued or running.
            work: The call.
            resources: What it needs.
        """
        ...

    def events(self, wait: float) -> list[Running | Ended]:
        """Return what has happened since the last call, in order.

        Args:
            wait: Longest time to wait if nothing has [s].
        """
        ...

    def stop(self) -> None:
        """Ask all calls to end, as Ctrl-C would; queued ones do not begin. `events` tells how each has ended."""
        ...


def open_engine(kind: str, address: str | None = None, jobs: int | None = None, logs: Path | None = None) -> Engine:
    """Open an engine.

    Args:
        kind: "local" for processes on this machine, "ray" for a Ray cluster.
        address: Address of the Ray cluster. None for the one that `RAY_ADDRESS` names or that runs on this machine;
            without either, one is started here.
        jobs: Largest number of calls at a time, for "local"; None for as many as the cores allow.
        logs: Folder for what the processes of "local" print, `NAME.log` for each call; None discards it. Ray has logs
            of its own.

    Raises:
        InputError: If the engine is not installed or cannot be reached, or an option is of the other kind.
    """
    if kind == "local":
        from modp_ti.tasks.local import LocalEngine

        if address is not None:
            raise InputError("--address is for --engine ray")
        return LocalEngine(jobs, logs)
    from modp_ti.tasks.ray_engine import RayEngine

    if jobs is not None:
        raise InputError("--jobs is for --engine local: with ray, --cpus, --gpus and --memory say what fits a machine")
    return RayEngine(address)

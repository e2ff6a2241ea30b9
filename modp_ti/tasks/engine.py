"""`Engine`: what carries out the calls of tasks, and the events by which it tells about them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol

from modp_ti.tasks.task import Answer, Resources, Work

__all__ = ["Ended", "Engine", "Running"]


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

"""`Task`: a call for a process of its own with the resources that it needs, and `Answer`: how the call ended."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

from fields.runtime.engine import EngineError
from modp_ti.files.errors import InputError
from modp_ti.files.urls import without_secrets

__all__ = ["Answer", "End", "Report", "Resources", "Task", "Work", "perform"]

Report = Callable[[Any], None]
"""Takes what a call tells of its progress, which must be picklable."""

Work = Callable[[Report], Any]
"""A picklable call, such as `functools.partial` of a function of a module. It returns something picklable."""


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
class Task:
    """A call with its name and resources.

    Attributes:
        name: Unique name.
        work: The call. A later attempt makes the same call, possibly on another machine, so the call itself must go on
            from what an earlier one left.
        resources: What it needs.
        attempts: How often it is begun if its process or its machine is lost.
    """

    name: str
    work: Work
    resources: Resources = Resources()
    attempts: int = 3


class End(str, Enum):
    """How a call ended."""

    done = "done"
    failed = "failed"
    """Its input cannot be used: another attempt would fail too."""
    fault = "fault"
    """An unexpected exception."""
    interrupted = "interrupted"
    lost = "lost"
    """Its process or its machine ended before the call did: another attempt may succeed."""


@dataclass(frozen=True)
class Answer:
    """The end of a call.

    Attributes:
        end: How it ended.
        value: What the call returned, None if it did not end with `done`.
        error: Otherwise one line that says why.
        traceback: Traceback of a fault, otherwise empty.
    """

    end: End
    value: Any = None
    error: str = ""
    traceback: str = ""


def perform(work: Work, report: Report) -> Answer:
    """Make a call in this process and return its end. Engines use this function in the processes that they start."""
    try:
        return Answer(End.done, work(report))
    except (InputError, EngineError) as error:
        return Answer(End.failed, error=str(error))
    except KeyboardInterrupt as stop:
        return Answer(End.interrupted, error=str(stop) or "interrupted")
    except Exception as error:
        what, where = f"a fault of the program ({error!r})", traceback.format_exc()
        return Answer(End.fault, error=without_secrets(what), traceback=without_secrets(where))

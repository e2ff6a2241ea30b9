"""Tasks: calls in processes of their own, on this machine or on a Ray cluster."""

from __future__ import annotations

from modp_ti.tasks.attempts import Retried, Stopping, Watched, run_tasks
from modp_ti.tasks.engine import Ended, Engine, Running
from modp_ti.tasks.opening import open_engine
from modp_ti.tasks.task import Answer, End, Report, Resources, Task

__all__ = [
    "Answer",
    "End",
    "Ended",
    "Engine",
    "Report",
    "Resources",
    "Retried",
    "Running",
    "Stopping",
    "Task",
    "Watched",
    "open_engine",
    "run_tasks",
]

"""`run_tasks`: carries tasks out with an engine, and begins again those whose process or machine is lost."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from modp_ti.engine.interruption import Interruption
from modp_ti.tasks.engine import Ended, Engine, Running
from modp_ti.tasks.task import Answer, End, Task

__all__ = ["Retried", "Stopping", "Watched", "run_tasks"]

# Longest wait for an event [s]: how often `watch` is called at least.
GLANCE = 0.5
# Time that interrupted tasks get to save what they have [s].
PATIENCE = 60.0


@dataclass(frozen=True)
class Retried:
    """A task whose process or machine was lost is queued again.

    Attributes:
        name: The task's name.
        attempt: Number of the new attempt, from 2.
        error: One line that says what happened.
    """

    name: str
    attempt: int
    error: str


@dataclass(frozen=True)
class Stopping:
    """Ctrl-C was pressed: the tasks save what they have and end."""


Watched = Running | Ended | Retried | Stopping


def run_tasks(
    engine: Engine, tasks: Sequence[Task], watch: Callable[[Watched | None], None] = lambda _: None
) -> dict[str, Answer]:
    """Carry out tasks and wait for all of them. The end of one has no influence on the others.

    Args:
        engine: The engine.
        tasks: The tasks, with unique names.
        watch: Called with every event, in this thread, and with None when nothing has happened for a moment. `Ended`
            is the end of a task, not of an attempt.

    Returns:
        The last answer of each task.

    Raises:
        KeyboardInterrupt: After Ctrl-C. The tasks have been asked to end before, and had time to. A second Ctrl-C
            raises it at once.
    """
    with Interruption(lambda: None) as stop:
        stop.begin()
        return _Tasks(engine, tasks, watch).run(stop)


class _Tasks:
    """Tasks in progress: their attempts, and the answers so far."""

    def __init__(self, engine: Engine, tasks: Sequence[Task], watch: Callable[[Watched | None], None]) -> None:
        self._engine = engine
        self._tasks = {task.name: task for task in tasks}
        self._watch = watch
        self._attempts = dict.fromkeys(self._tasks, 1)
        self._answers: dict[str, Answer] = {}

    def run(self, stop: Interruption) -> dict[str, Answer]:
        for task in self._tasks.values():
            self._engine.submit(task.name, task.work, task.resources)
        while self._left and not stop.asked:
            self._look(retry=True)
        if self._left:
            self._engine.stop()
            self._watch(Stopping())
            until = time.monotonic() + PATIENCE
            while self._left and time.monotonic() < until:
                self._look(retry=False)
            raise KeyboardInterrupt
        return self._answers

    @property
    def _left(self) -> int:
        return len(self._tasks) - len(self._answers)

    def _look(self, retry: bool) -> None:
        """Wait for events for a moment, and pass them on. With `retry`, lost tasks are queued again."""
        events = self._engine.events(GLANCE)
        for event in events:
            self._watch(self._ended(event, retry) if isinstance(event, Ended) else event)
        if not events:
            self._watch(None)

    def _ended(self, event: Ended, retry: bool) -> Ended | Retried:
        task, answer = self._tasks[event.name], event.answer
        if not retry or answer.end is not End.lost or self._attempts[task.name] >= task.attempts:
            self._answers[task.name] = answer
            return event
        self._attempts[task.name] += 1
        self._engine.submit(task.name, task.work, task.resources)
        return Retried(task.name, self._attempts[task.name], answer.error)

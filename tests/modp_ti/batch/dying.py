"""A scene's work that dies on the way, for the tests of batches."""

from __future__ import annotations

import os
import shutil
import signal
from pathlib import Path
from typing import Any

from modp_ti.tasks import Report
from modp_ti.tasks.task import Work

__all__ = ["lose_machine_once"]


def lose_machine_once(work: Work, snapshots: int, died: Path, output: Path, report: Report) -> Any:
    """Do the work. The first time, kill this process after so many snapshots, and remove its output folder.

    This is what a lost machine leaves: what was copied to a storage, and nothing else.
    """
    from modp_ti.engine.snapshots import Checkpointer

    keep = Checkpointer.keep

    def keep_and_die(self: Checkpointer) -> bool:
        kept = keep(self)
        if self.written == snapshots:
            died.touch()
            shutil.rmtree(output)
            os.kill(os.getpid(), signal.SIGKILL)
        return kept

    if not died.exists():
        Checkpointer.keep = keep_and_die
    return work(report)

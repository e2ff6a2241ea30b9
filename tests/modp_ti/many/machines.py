"""Machines of a Ray cluster that are processes here, and can be lost."""

from __future__ import annotations

import os
import signal
from contextlib import suppress
from pathlib import Path
from typing import Any


def made_cluster() -> Any:
    """A cluster of a head, which runs no calls, and two machines of one core. Whoever makes it shuts it down."""
    from ray.cluster_utils import Cluster  # an extra

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    for _ in range(2):
        cluster.add_node(num_cpus=1)
    return cluster


class Machine:
    """A machine of a cluster: a raylet and the processes that it has started."""

    def __init__(self, node: Any) -> None:
        self._raylet = node.all_processes["raylet"][0].process.pid

    def lose(self) -> None:
        """Kill all of its processes at once."""
        for process in (self._raylet, *_children(self._raylet)):
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)


def other_machine(cluster: Any) -> Machine:
    """A machine that runs calls, and is not the one that this process is connected to, whose loss would end it."""
    import ray  # an extra

    ours = ray.get_runtime_context().get_node_id()
    return Machine(next(node for node in cluster.worker_nodes if node.node_id != ours))


def _children(parent: int) -> list[int]:
    """Its processes and theirs: also those of the tasks, which a machine takes with it."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            if int(stat.read_text().rpartition(")")[2].split()[1]) == parent:
                found += [int(stat.parent.name), *_children(int(stat.parent.name))]
    return found

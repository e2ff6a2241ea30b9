"""Opens the engine that a command names."""

from __future__ import annotations

from pathlib import Path

from modp_ti.files.errors import InputError
from modp_ti.tasks.engine import Engine
from modp_ti.tasks.local import LocalEngine
from modp_ti.tasks.ray_engine import RayEngine

__all__ = ["open_engine"]


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
        if address is not None:
            raise InputError("--address is for --engine ray")
        return LocalEngine(jobs, logs)
    if jobs is not None:
        raise InputError("--jobs is for --engine local: with ray, --cpus, --gpus and --memory say what fits a machine")
    return RayEngine(address)

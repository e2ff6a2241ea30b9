"""`SceneResult`: what became of a scene of a batch, and the tables of all of them."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from enum import Enum
from pathlib import Path
from typing import Any

from modp_ti.files.atomic import replacing

__all__ = ["SceneResult", "State", "as_row", "figures", "last_stage", "write_csv", "write_parquet"]


class State(str, Enum):
    """What became of a scene."""

    finished = "finished"
    before = "finished before"
    """An earlier batch or run had finished it, with the same settings."""
    failed = "failed"
    waiting = "waiting"
    """It has not ended yet, or was interrupted; the same command goes on."""


@dataclass(frozen=True)
class SceneResult:
    """A row of the tables. Figures are None where the scene is not finished, and as in `metrics.json` otherwise.

    Attributes:
        name: Name of the scene in the batch.
        scene: What the user named.
        output: Its output folder, None if its settings cannot be read.
        state: What became of it.
        attempts: How often it was begun in this batch.
        machine: Where the last attempt ran, "" if it is not known.
        error: One line that says why it failed, otherwise "".
        frames: Number of frames.
        keyframes: Number of keyframes.
        gaussians: Number of Gaussians.
        scored: Frames of the scores: "held_out", or "all" where none was held out.
        psnr: Mean PSNR of the final map [dB].
        ssim: Mean SSIM.
        lpips: Mean LPIPS, None without its weights.
        detail: Mean detail score.
        ate_rmse: Trajectory error [units of the ground truth], None without ground truth.
        seconds: Time of the run [s], lost work left out.
        frames_per_second: Frames per second while mapping.
        peak_memory_mb: Peak memory of the process that finished it [MB].
        resumed: How often the run was resumed from a snapshot.
    """

    name: str
    scene: str
    output: str | None
    state: State
    attempts: int = 0
    machine: str = ""
    error: str = ""
    frames: int | None = None
    keyframes: int | None = None
    gaussians: int | None = None
    scored: str | None = None
    psnr: float | None = None
    ssim: float | None = None
    lpips: float | None = None
    detail: float | None = None
    ate_rmse: float | None = None
    seconds: float | None = None
    frames_per_second: float | None = None
    peak_memory_mb: float | None = None
    resumed: int | None = None


COLUMNS = [field.name for field in fields(SceneResult)]
TEXTS = ("name", "scene", "output", "state", "machine", "error", "scored")
COUNTS = ("attempts", "frames", "keyframes", "gaussians", "resumed")


def figures(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of a `SceneResult` from the content of `metrics.json`."""
    stage = last_stage(metrics)
    scored = "held_out" if stage["held_out"]["count"] else "all"
    of_run = ("frames", "keyframes", "gaussians", "frames_per_second", "peak_memory_mb", "ate_rmse")
    return {
        **{name: metrics.get(name) for name in of_run},
        "scored": scored,
        **{name: stage[scored].get(name) for name in ("psnr", "ssim", "lpips", "detail")},
        "seconds": metrics["seconds"]["total"],
        "resumed": metrics["snapshots"]["resumed"],
    }


def last_stage(metrics: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the entry of the final map in the content of `metrics.json`."""
    return next(metrics[stage] for stage in ("refined", "online", "offline") if metrics.get(stage))


def as_row(result: SceneResult) -> dict[str, Any]:
    """Return the columns of a result as plain values."""
    return {name: getattr(result, name) for name in COLUMNS} | {"state": result.state.value}


def write_csv(path: Path, results: Sequence[SceneResult]) -> None:
    """Write the table with a header line; unknown values are empty. Raises OSError if it cannot be written."""
    with replacing(path, "w") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(as_row(result) for result in results)


def write_parquet(path: Path, results: Sequence[SceneResult]) -> bool:
    """Write the table as a Parquet file, and return False if pyarrow is not installed. Raises OSError as `write_csv`.

    The types of the columns do not depend on the values.
    """
    try:
        import pyarrow  # pyright: ignore[reportMissingImports] - not a dependency
        import pyarrow.parquet  # pyright: ignore[reportMissingImports]
    except ImportError:
        return False
    types = dict.fromkeys(COLUMNS, pyarrow.float64())
    types |= dict.fromkeys(TEXTS, pyarrow.string()) | dict.fromkeys(COUNTS, pyarrow.int64())
    table = pyarrow.Table.from_pylist([as_row(result) for result in results], schema=pyarrow.schema(types.items()))
    with replacing(path) as file:
        pyarrow.parquet.write_table(table, file)
    return True

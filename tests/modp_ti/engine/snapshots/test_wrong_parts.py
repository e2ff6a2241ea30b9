"""Parts of a snapshot that have right checksums and another form than we write are refused in one line, at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modp_ti.engine.snapshots.snapshot import Position, Snapshot, frames_state, record_state, version_state
from modp_ti.files.errors import InputError
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.outputs.evaluation import MapVersion
from modp_ti.outputs.report.record import FrameNote, RunRecord, StepNote
from tests.pipelines.wall import frame

GAUSSIANS = {
    "position": np.zeros((5, 3), np.float32),
    "log_scale": np.zeros((5, 3), np.float32),
    "quaternion": np.ones((5, 4), np.float32),
    "opacity_logit": np.zeros(5, np.float32),
    "sh": np.zeros((5, 4, 3), np.float32),
}


@pytest.fixture(scope="module")
def whole() -> Snapshot:
    """A snapshot of three frames during refinement, without a map."""
    delivered = DeliveredFrames()
    for i in range(3):
        delivered.add(frame(i))
    record = RunRecord()
    record.frames = [FrameNote(i, False, True, 0.5 * i, 5, None) for i in range(3)]
    record.steps = [StepNote(1, 20.0)]
    version = version_state(MapVersion(GAUSSIANS, delivered.T_tracked, [None, None, np.eye(3, 4)], 7))
    frames = frames_state(delivered)
    times = {"started": 1.7e9, "total": 2.0, "mapping": 1.0, "resumed": 0, "written": 1}
    numbers = {"frames": frames.numbers, "online": version.numbers, "watch": {"select": 0.1}, **times}
    arrays = frames.arrays | version.arrays | record_state(record).arrays
    return Snapshot(Path("snapshot.npz"), {}, Position(3, 0), arrays, numbers)


def restore(snapshot: Snapshot) -> None:
    """Restore what a snapshot holds besides the map, and write it again."""
    record = RunRecord()
    with snapshot.fitting():
        frames = snapshot.frames(DeliveredFrames().trajectory)
        online = snapshot.online()
        snapshot.record(record)
        for name in ("started", "total", "mapping", "resumed", "written"):
            snapshot.number(name)
        snapshot.number("watch", "select")
    for again in (frames_state(frames), version_state(online), record_state(record)):
        assert again.arrays


def refused(snapshot: Snapshot) -> None:
    with pytest.raises(InputError) as error:
        restore(snapshot)
    assert str(error.value).startswith("snapshot.npz: ") and "\n" not in str(error.value)


CHANGES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "a row less": lambda array: array[:-1],
    "other numbers": lambda array: array.astype(np.float64 if array.dtype.kind in "iub" else np.int64),
    "another dimension": lambda array: array[..., None],
}


def test_a_whole_one_is_restored(whole: Snapshot) -> None:
    restore(whole)


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_arrays_of_another_form_are_refused(whole: Snapshot, change: Callable[[np.ndarray], np.ndarray]) -> None:
    changed = {name: change(array) for name, array in whole.arrays.items() if len(array)}
    if change is CHANGES["other numbers"]:  # positions and Gaussians may be any numbers, which are converted
        changed = {name: array for name, array in changed.items() if not name.startswith(("online", "points."))}
    assert len(changed) > 8
    for name, array in changed.items():
        refused(replace(whole, arrays=whole.arrays | {name: array}))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("frames", {"name": [1, 2, 3], "corrections": {"received": 0, "moved": 0}}),
        ("frames", {"name": ["a", "b", "c"], "corrections": {}}),
        ("watch", {"select": "much"}),
        ("watch", {"select": None}),
        ("started", 1e300),
        ("total", float("nan")),
        ("mapping", []),
        ("resumed", -1),
        ("online", {"view_renders": None}),
    ],
)
def test_numbers_of_another_form_are_refused(whole: Snapshot, key: str, value: Any) -> None:
    refused(replace(whole, numbers=whole.numbers | {key: value}))

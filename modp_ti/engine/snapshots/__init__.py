"""Snapshots: the state of a run, saved while it goes on, so that an interrupted run can be resumed."""

from __future__ import annotations

from modp_ti.engine.snapshots.checkpointer import Checkpointer
from modp_ti.engine.snapshots.resume import Recovery, continued, discard, fetch_snapshot, load_resumed, replay
from modp_ti.engine.snapshots.snapshot import FILE, Snapshot

__all__ = [
    "FILE",
    "Checkpointer",
    "Recovery",
    "Snapshot",
    "continued",
    "discard",
    "fetch_snapshot",
    "load_resumed",
    "replay",
]

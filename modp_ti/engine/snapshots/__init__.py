"""Snapshots: the state of a run, saved while it goes on, so that an interrupted run can be resumed."""

from __future__ import annotations

from modp_ti.engine.snapshots.checkpointer import Checkpointer
from modp_ti.engine.snapshots.resume import continued, fetch_snapshot, load_resumed, replay
from modp_ti.engine.snapshots.snapshot import Snapshot

__all__ = ["Checkpointer", "Snapshot", "continued", "fetch_snapshot", "load_resumed", "replay"]

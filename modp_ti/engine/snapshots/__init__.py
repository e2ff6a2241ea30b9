"""Snapshots of a run: what is kept while it goes on, so that it can go on after it was stopped."""

from __future__ import annotations

from modp_ti.engine.snapshots.checkpointer import Checkpointer
from modp_ti.engine.snapshots.resume import load_resumed, replay
from modp_ti.engine.snapshots.snapshot import Snapshot

__all__ = ["Checkpointer", "Snapshot", "load_resumed", "replay"]

"""Snapshots of a run: what is kept while it goes on, so that it can go on after it was stopped."""

from __future__ import annotations

from modp_ti.snapshots.keeper import Keeper
from modp_ti.snapshots.resume import load_resumed, replay
from modp_ti.snapshots.snapshot import Snapshot

__all__ = ["Keeper", "Snapshot", "load_resumed", "replay"]

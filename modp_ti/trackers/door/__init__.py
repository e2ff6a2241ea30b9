"""A door for trackers in other programs: their frames, poses, points and corrections come through a socket.

`docs/door.md` has the messages byte by byte.
"""

from __future__ import annotations

from modp_ti.trackers.door.tracker import DoorTracker, open_door

__all__ = ["DoorTracker", "open_door"]

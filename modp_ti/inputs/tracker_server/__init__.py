"""A server for trackers in other programs: their frames, poses, points and corrections come through a socket.

`docs/tracker_server.md` has the messages byte by byte.
"""

from __future__ import annotations

from modp_ti.inputs.tracker_server.tracker import TrackerServer, open_tracker_server

__all__ = ["TrackerServer", "open_tracker_server"]

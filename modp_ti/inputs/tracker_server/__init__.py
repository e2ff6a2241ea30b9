"""A server that receives frames, poses, points and corrections from a tracker in another program through a socket.

`docs/tracker_server.md` specifies the messages byte by byte.
"""

from __future__ import annotations

from modp_ti.inputs.tracker_server.tracker import TrackerServer

__all__ = ["TrackerServer"]

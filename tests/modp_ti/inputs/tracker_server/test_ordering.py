"""What may wait behind a frame without a pose is bounded."""

from __future__ import annotations

import numpy as np
import pytest

from fields.frames.tracked_frame import SparsePoints
from modp_ti.inputs.tracker_server import ordering
from modp_ti.inputs.tracker_server.messages import Frame, ProtocolError, State
from modp_ti.inputs.tracker_server.ordering import Ordering


def frame(number: int, state: State, points: int = 0) -> Frame:
    pose = np.eye(4) if state is State.KNOWN else None
    some = SparsePoints(np.zeros((points, 3)), np.zeros((points, 2)), np.arange(points))
    return Frame(number, state, float(number), pose, some, b"")


def test_frames_that_wait_for_ever_are_refused() -> None:
    waiting = Ordering()
    waiting.add_frame(frame(7, State.LATER))
    with pytest.raises(ProtocolError, match="wait for the pose of FRAME 7"):
        for number in range(8, 8 + ordering.MAX_WAITING):
            waiting.add_frame(frame(number, State.KNOWN))
    assert list(waiting.ready()) == []


def test_points_that_wait_are_bounded_and_counted_off_when_they_go() -> None:
    waiting = Ordering()
    most = ordering.MAX_WAITING_BYTES // (48 * 100_000)
    for start in (0, 1_000):  # twice: what has gone does not count
        waiting.add_frame(frame(start, State.LATER))
        for number in range(start + 1, start + 1 + most):
            waiting.add_frame(frame(number, State.KNOWN, 100_000))
        waiting.add_pose(frame(start, State.KNOWN))
        assert len(list(waiting.ready())) == most + 1
    waiting.add_frame(frame(2_000, State.LATER))
    with pytest.raises(ProtocolError, match="wait for the pose of FRAME 2000"):
        for number in range(2_001, 2_002 + most):
            waiting.add_frame(frame(number, State.KNOWN, 100_000))

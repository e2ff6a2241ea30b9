"""Delivered frames come again in order, with the poses and points of the last correction."""

from __future__ import annotations

import resource
import signal

import numpy as np
import pytest

from fields.frames.pose_correction import PoseCorrection
from modp_ti.inputs.tracking_process.delivered_log import DeliveredLog
from modp_ti.inputs.tracking_process.frame_record import FrameRecord
from tests.modp_ti.inputs.tracking_process.frames import random_frame


def test_corrections_move_the_frames_and_points_that_they_list():
    log = DeliveredLog()
    frames = [random_frame(i, points=n) for i, n in enumerate((4, 0, 3))]
    for frame in frames:
        log.add(FrameRecord.of(frame))
    T = np.eye(4)
    T[0, 3] = 9.0
    log.correct(PoseCorrection(np.array([2]), T[None], np.array([3, 77]), np.array([[1.0, 2.0, 3.0], [0, 0, 1]])))
    for _ in range(2):
        first, second, third = log
        np.testing.assert_array_equal(first.T_camera_world, frames[0].T_camera_world)
        np.testing.assert_array_equal(third.T_camera_world, T)
        assert [len(record.points) for record in log] == [4, 0, 3]
        np.testing.assert_array_equal(first.points.pixels, frames[0].points.pixels)
        np.testing.assert_array_equal(first.points.xyz[:3], frames[0].points.xyz[:3])
        assert first.points.xyz[3].tolist() == third.points.xyz[1].tolist() == [1, 2, 3], "point 3, in both"
        assert second.points.ids.tolist() == []
    log.add(FrameRecord.of(random_frame(3)))
    assert len(log) == 4 and len(list(log)[3].points) == 5
    log.close()


def test_frames_that_a_full_disk_cannot_take_leave_the_others_as_they_were(monkeypatch: pytest.MonkeyPatch):
    """A limit on a file's size stands for the disk: the system refuses what lies beyond it, in the midst of a write."""
    log, limits = DeliveredLog(), resource.getrlimit(resource.RLIMIT_FSIZE)
    frames = [random_frame(i, points=8) for i in range(3)]
    log.add(FrameRecord.of(frames[0]))
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (700, limits[1]))
        with pytest.raises(OSError):
            log.add(FrameRecord.of(frames[1]))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    log.add(FrameRecord.of(frames[2]))
    first, last = log
    np.testing.assert_array_equal(first.points.xyz, frames[0].points.xyz)
    np.testing.assert_array_equal(last.points.xyz, frames[2].points.xyz)
    log.close()

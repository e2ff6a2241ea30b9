"""Frames wait for the mapper in order, most without their images; counts are seen on the other side."""

from __future__ import annotations

import threading

import numpy as np

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.inputs.sources import Picture
from modp_ti.inputs.tracking_process import child as module
from modp_ti.inputs.tracking_process.child import Outbox
from tests.modp_ti.inputs.tracking_process.frames import assert_same, random_frame
from tests.patience import PATIENCE


def test_order_is_kept_and_only_the_first_frames_keep_their_images():
    correction = PoseCorrection(np.array([0]), np.eye(4)[None])
    frames = [random_frame(i) for i in range(5)]
    outbox = Outbox(room=2 * frames[0].image.nbytes)
    for frame in frames[:3]:
        outbox.put(frame)
    outbox.put(correction)
    assert outbox.get() is frames[0]
    outbox.put(frames[3])  # there is room for an image again
    outbox.put(frames[4])
    got = [outbox.get() for _ in range(5)]
    assert got[0] is frames[1] and got[2] is correction and got[3] is frames[3]
    assert isinstance(got[1], dict) and isinstance(got[4], dict)
    picture = Picture(frames[2].image, None, None, frames[2].camera)
    assert_same(TrackedFrame(**got[1], **vars(picture)), frames[2])


def test_the_tracker_waits_only_at_the_limit(monkeypatch):
    monkeypatch.setattr(module, "LIMIT", 3)
    outbox = Outbox(room=1)
    put = threading.Semaphore(0)

    def track() -> None:
        for i in range(4):
            outbox.put(random_frame(i))
            put.release()

    thread = threading.Thread(target=track, daemon=True)
    thread.start()
    for _ in range(3):
        assert put.acquire(timeout=PATIENCE)
    assert not put.acquire(timeout=0.05)
    first = outbox.get()
    assert isinstance(first, TrackedFrame) and first.index == 0
    assert put.acquire(timeout=PATIENCE)
    thread.join(PATIENCE)
    second, third, last = (outbox.get() for _ in range(3))
    assert (second["index"], third["index"], last.index) == (1, 2, 3)

"""What one process writes to a slot is what the other reads, and nothing is left when both are done."""

from __future__ import annotations

import os

import numpy as np
import pytest

from fields.frames.tracked_frame import TrackedFrame
from modp_ti.files.errors import InputError
from modp_ti.inputs.frame_record import FrameRecord
from modp_ti.inputs.protocol import LiveCounts
from modp_ti.inputs.tracking_process.exchange import CountsBoard, Delivered, FrameRing, SlotLayout, anonymous_memory
from tests.modp_ti.inputs.tracking_process.frames import assert_same, random_frame


@pytest.fixture
def memory():
    descriptor = anonymous_memory()
    yield descriptor
    os.close(descriptor)


def read(ring: FrameRing, slot: int, frame: TrackedFrame) -> TrackedFrame:
    return ring.read(Delivered(slot, FrameRecord.of(frame), frame.camera, frame.mask is not None), None)


def test_frames_pass_through_reused_slots_byte_for_byte(memory):
    layout = SlotLayout.of(random_frame(0))
    writer, reader = FrameRing(memory, layout, 3), FrameRing(memory, layout, 3)
    for i in range(8):
        frame = random_frame(i, masked=i % 3 == 1)
        writer.write(i % 3, frame)
        got = read(reader, i % 3, frame)
        assert_same(got, frame)
        assert got.arrived == frame.arrived
    writer.write(7 % 3, random_frame(99))
    assert_same(got, frame)


def test_slots_do_not_touch_each_other(memory):
    frames = [random_frame(i, masked=True) for i in range(4)]
    ring = FrameRing(memory, SlotLayout.of(frames[0]), 4)
    for slot, frame in enumerate(frames):
        ring.write(slot, frame)
    for slot, frame in enumerate(frames):
        assert_same(read(ring, slot, frame), frame)


def test_pyramid_is_not_built_again(memory):
    frame = random_frame(1)
    ring = FrameRing(memory, SlotLayout.of(frame), 1)
    ring.write(0, frame)
    got = read(ring, 0, frame)
    assert set(got.__dict__) >= {"rgba", "pyramid"} and len(got.pyramid) > 1
    assert got.pyramid[0].rgba is got.rgba


def test_a_frame_of_another_size_is_refused(memory):
    ring = FrameRing(memory, SlotLayout.of(random_frame(0)), 1)
    with pytest.raises(InputError, match="live_000003 is 60x46, the first frame 50x46: all images of a scene must"):
        ring.write(0, random_frame(3, width=60))


def test_the_counts_are_seen_on_the_other_side(memory):
    child, parent = CountsBoard(memory), CountsBoard(memory)
    child.write(LiveCounts(arrived=20, tracked=12, thinned=5, lost=1, waiting=0, newest=7.5), 30)
    assert parent.counts(delivered=9) == LiveCounts(20, 12, 5, 1, waiting=3, newest=7.5)
    assert parent.frame_count == 30
    child.write(None, None)
    assert parent.frame_count is None and parent.counts(0).arrived == 20
    assert not child.finish
    parent.finish = True
    assert child.finish


def test_memory_has_no_name_and_goes_with_its_descriptor():
    before = set(os.listdir("/dev/shm")) if os.path.isdir("/dev/shm") else set()
    descriptor = anonymous_memory()
    FrameRing(descriptor, SlotLayout.of(random_frame(0)), 2)
    assert os.fstat(descriptor).st_nlink == 0
    os.close(descriptor)
    assert (set(os.listdir("/dev/shm")) if os.path.isdir("/dev/shm") else set()) <= before


def test_an_image_that_is_written_later_does_not_change_one_that_was_read(memory):
    frame = random_frame(0)
    ring = FrameRing(memory, SlotLayout.of(frame), 1)
    ring.write(0, frame)
    got = read(ring, 0, frame)
    ring.write(0, random_frame(5))
    np.testing.assert_array_equal(got.image, frame.image)

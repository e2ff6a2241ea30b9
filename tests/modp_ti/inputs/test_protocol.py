"""A tracker need only have notes and frames: what few can do has a default."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pytest

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.commands.input import _lens
from modp_ti.inputs.delivered_frames import settled
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.sources import Picture


class Plain(Tracker):
    """Two frames, and nothing else."""

    @property
    def notes(self) -> list[str]:
        return []

    def pictures(self, names: Sequence[str]) -> Iterator[tuple[str, Picture]]:
        return iter(())

    def __iter__(self) -> Iterator[TrackedFrame]:
        camera = PinholeCamera(10.0, 10.0, 4.0, 4.0, 8, 8)
        for i in range(2):
            yield TrackedFrame(i, float(i), str(i), np.zeros((8, 8, 3), np.float32), camera, np.eye(4))


def test_what_few_trackers_can_do_has_a_default():
    tracker = Plain()
    assert [frame.name for frame in tracker] == ["0", "1"]
    assert [frame.index for frame in settled(tracker)] == [0, 1]
    assert not tracker.reads_ahead
    assert tracker.frame_count is None and tracker.undistorter is None
    assert not tracker.unreadable
    assert _lens(tracker) == ""
    tracker.close()


def test_a_tracker_without_frames_or_notes_is_none():
    class Half(Tracker):
        @property
        def notes(self) -> list[str]:
            return []

    with pytest.raises(TypeError, match="__iter__"):
        Half()

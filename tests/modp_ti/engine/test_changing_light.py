"""A camera whose exposure wanders: what estimating it is worth on frames that the map never saw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fields.frames.tracked_frame import TrackedFrame
from fields.runtime.backend import initialise
from modp_ti.outputs.evaluation import score_frame
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from tests.room import Room, RoomRecording, pinhole, walk
from tests.simulated_tracker import smooth_walks

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 80, 60
# The exposure is correlated over this many frames: it changes too fast for the map to average it, and slowly enough to
# be interpolated between keyframes.
SMOOTH = 3.0


@pytest.fixture(scope="module")
def frames(room: Room) -> list[TrackedFrame]:
    """20 frames, every fifth of them held out, of a camera with a changing exposure and a vignette."""
    recording = RoomRecording(room, pinhole(WIDTH, HEIGHT), walk(20))
    walks = smooth_walks(20, 7, SMOOTH, np.random.default_rng(4))
    gain = np.exp(0.4 * walks[:, :1] + 0.1 * walks[:, 1:4])
    offset = 0.02 * walks[:, 4:]
    x, y = ((2 * np.arange(size) + 1) / size - 1 for size in (WIDTH, HEIGHT))
    vignette = np.repeat((1 - 0.25 * (x**2 + y[:, None] ** 2))[..., None], 3, axis=2).astype(np.float32)
    return [
        replace(
            frame,
            image=np.clip((gain[i] * frame.image + offset[i]) * vignette, 0, 1).astype(np.float32),
            vignette=vignette,
            held_out=i % 5 == 0,
        )
        for i, frame in enumerate(recording.frames())
    ]


def held_out_psnr(frames: list[TrackedFrame], **exposure: object) -> float:
    """Mean PSNR of the held-out frames on a map of the others."""
    initialise("cpu")  # one process does not hold all these maps
    settings = MappingSettings(optimise={"steps": 15}, densify={"pixels": 8000, "warm_up": 2}, exposure=exposure)
    mapper = OnlineMapper(settings, WIDTH, HEIGHT, seed=1)
    for frame in frames:
        if not frame.held_out:
            mapper.process(frame)
    mapper.finish()
    store = mapper.keyframes
    scores = [
        score_frame(
            mapper,
            frame,
            store.corrected(frame.index, frame.T_camera_world),
            "online",
            exposure=store.exposure_at(frame.index),
        )[0].psnr
        for frame in frames
        if frame.held_out
    ]
    return float(np.mean(scores))


def test_estimated_exposure_wins_at_least_four_decibels(frames: list[TrackedFrame]) -> None:
    # 8.6 to 11.6 dB over three seeds of the light.
    fixed = held_out_psnr(frames, enabled=False)
    assert min(held_out_psnr(frames, enabled=enabled) for enabled in (True, "auto")) > fixed + 4.0

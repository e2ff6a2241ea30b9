"""A camera whose exposure wanders: what estimating it is worth on frames that the map never saw."""

from __future__ import annotations

import numpy as np
import pytest

from fields.frames.tracked_frame import TrackedFrame
from fields.runtime.backend import initialise
from modp_ti.inputs.synthetic import LightChange, SyntheticTracker
from modp_ti.inputs.synthetic.renderer import RoomRenderer
from modp_ti.outputs.evaluation import score_frame
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 112, 84
# Wanders faster than the map could pass for the mean of, and slowly enough to be interpolated between keyframes.
LIGHT = LightChange(gain=0.4, white_balance=0.1, bias=0.02, drift=3.0, vignette=0.5)


@pytest.fixture(scope="module")
def frames(taichi_on_the_cpu: None) -> list[TrackedFrame]:
    """The first 20 frames, every fifth of them held out."""
    room = RoomRenderer(texel=0.3)
    return list(
        SyntheticTracker(
            width=WIDTH, height=HEIGHT, select=slice(20), holdout=5, points=150, light=LIGHT, seed=4, room=room
        )
    )


def held_out_psnr(frames: list[TrackedFrame], **exposure: object) -> float:
    """Mean PSNR of the held-out frames on a map of the others."""
    initialise("cpu")  # one process does not hold all these maps
    settings = MappingSettings(optimise={"steps": 15}, densify={"pixels": 8000, "warm_up": 2}, exposure=exposure)
    mapper = OnlineMapper(settings, WIDTH, HEIGHT, seed=1)
    for frame in frames:
        if not frame.held_out:
            mapper.process(frame)
    mapper.finish()
    store, near = mapper.keyframes, settings.near * mapper.keyframes.scene_depth
    scores = [
        score_frame(
            mapper.renderer,
            mapper.optimiser.loss,
            frame,
            store.corrected(frame.index, frame.T_camera_world),
            near,
            "online",
            exposure=store.exposure_at(frame.index),
        )[0].psnr
        for frame in frames
        if frame.held_out
    ]
    return float(np.mean(scores))


def test_estimated_exposure_wins_at_least_a_decibel(frames: list[TrackedFrame]) -> None:
    """Measured when this was written: 19.8 dB without, 22.6 dB with."""
    assert held_out_psnr(frames, enabled=True) > held_out_psnr(frames) + 1.0

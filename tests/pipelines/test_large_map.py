"""A map beyond what Taichi holds. It needs 6.5 GB of memory and two minutes: MODP_ENGINE=quadrants pytest THIS_FILE."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.gaussians import GaussianField
from fields.map.keyframes import KeyframeStore
from fields.runtime.engine import engine
from modp_ti.outputs.formats.splats_ply import read_splats, write_splats
from pipelines.optimise.map_optimiser import MapOptimiser
from pipelines.render.renderer import Renderer
from pipelines.settings import MappingSettings

COUNT = 3_000_000
CHUNK = 250_000
STEPS = 20
DEPTH = 4.0
CAMERA = PinholeCamera(300.0, 300.0, 160.0, 120.0, 320, 240)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(engine().max_gaussians < COUNT, reason=f"{engine().title} holds fewer Gaussians"),
]


def made_up(count: int, rng: np.random.Generator) -> dict[str, NDArray]:
    """Small grey Gaussians around a plane in front of the camera; every second one lies behind it instead."""
    position = rng.uniform((-2.0, -1.5, DEPTH - 0.2), (2.0, 1.5, DEPTH + 0.2), (count, 3))
    position[1::2, 2] *= -1.0
    return {
        "position": position.astype(np.float32),
        "log_scale": rng.normal(np.log(0.7 * DEPTH / CAMERA.fx), 0.2, (count, 3)).astype(np.float32),
        "quaternion": rng.normal(size=(count, 4)).astype(np.float32),
        "opacity_logit": rng.normal(-2.0, 0.5, count).astype(np.float32),
        "sh": rng.normal(0.0, 0.1, (count, 16, 3)).astype(np.float32),
    }


def keyframe(rng: np.random.Generator) -> KeyframeStore:
    """One view of a smooth picture."""
    u, v = np.meshgrid(np.linspace(0, 6, CAMERA.width), np.linspace(0, 5, CAMERA.height))
    image = np.stack([0.5 + 0.4 * np.sin(u + phase) * np.cos(v) for phase in (0.0, 1.0, 2.0)], axis=-1)
    points = SparsePoints(rng.uniform((-1, -1, DEPTH), (1, 1, DEPTH + 0.01), (50, 3)), np.ones((50, 2)), np.arange(50))
    store = KeyframeStore()
    store.append(TrackedFrame(0, 0.0, "0", image.astype(np.float32), CAMERA, np.eye(4), points))
    return store


def test_three_million_gaussians_are_filled_optimised_saved_and_read_back_without_a_wrong_entry(tmp_path: Path) -> None:
    gaussians = GaussianField(3, COUNT)
    for seed in range(COUNT // CHUNK):
        gaussians.append(**made_up(CHUNK, np.random.default_rng(seed)))
    assert len(gaussians) == COUNT > 1_500_000

    def differing(held: dict[str, NDArray], only: slice) -> dict[str, int]:
        """Count the entries of every second Gaussian that are not those that were appended."""
        found = dict.fromkeys(held, 0)
        for seed in range(COUNT // CHUNK):
            for name, value in made_up(CHUNK, np.random.default_rng(seed)).items():
                part = held[name][seed * CHUNK : (seed + 1) * CHUNK]
                found[name] += int(np.count_nonzero(part[only] != value[only]))
        return found

    everyone, in_view, behind = slice(None), slice(0, None, 2), slice(1, None, 2)
    nothing = {"position": 0, "log_scale": 0, "quaternion": 0, "opacity_logit": 0, "sh": 0}
    assert differing(gaussians.to_numpy(), everyone) == nothing

    optimiser = MapOptimiser(gaussians, Renderer(gaussians, CAMERA.width, CAMERA.height), MappingSettings(sh_degree=3))
    store = keyframe(np.random.default_rng(0))
    before = optimiser.compare(store[0], DEPTH).psnr
    for _ in range(STEPS):
        optimiser.step(store, [0], optimiser.rates(DEPTH), pose_rate=0.0)
    assert optimiser.compare(store[0], DEPTH).psnr > before + 3.0
    held = gaussians.to_numpy()
    assert all(np.isfinite(value).all() for value in held.values())
    assert differing(held, behind) == nothing  # a step writes only to Gaussians in view
    assert differing(held, in_view)["opacity_logit"] > 0.5 * COUNT / 2

    write_splats(tmp_path / "splats.ply", held)
    read = read_splats(tmp_path / "splats.ply")
    for name in nothing:
        assert np.array_equal(read[name], held[name]), name
    del held
    gaussians.load(read)
    again = gaussians.to_numpy()
    for name in nothing:
        assert np.array_equal(again[name], read[name]), name

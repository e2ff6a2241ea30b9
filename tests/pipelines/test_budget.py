"""Maps within a budget of memory, and large ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.gaussians import GaussianField
from fields.map.keyframes import KeyframeStore
from fields.runtime.backend import initialise
from fields.runtime.engine import engine, ti
from modp_ti.outputs.formats.splats_ply import read_splats, write_splats
from pipelines.online import OnlineMapper
from pipelines.optimise.map_optimiser import MapOptimiser
from pipelines.render.renderer import Renderer
from pipelines.safeguards import Safeguards
from pipelines.settings import MappingSettings
from tests.pipelines.wall import frame

pytestmark = pytest.mark.slow

FRAMES = 6
VIEWS = MappingSettings().views


@dataclass
class Mapped:
    """What is left of a map."""

    gaussians: dict[str, np.ndarray]
    keyframes: list[int]  # their frames
    safeguards: Safeguards
    held: int  # what the budget says [bytes]
    counted: int  # what its arrays hold [bytes]
    renders: int  # views that it was optimised for


def mapped(memory: float | None, frames: int = FRAMES) -> Mapped:
    """A map of so many frames with so much memory [GB]."""
    initialise("cpu")
    settings = MappingSettings(sh_degree=0, optimise={"steps": 2}, densify={"warm_up": 2}, memory=memory)
    mapper = OnlineMapper(settings, 64, 48, seed=1)
    mapper.compile()
    for i in range(frames):
        mapper.process(frame(i))
    mapper.finish()
    images = sum(level.rgba.nbytes for view in mapper.keyframes for level in view.pyramid)
    points = sum(a.nbytes for v in mapper.keyframes for a in (v.points.xyz, v.points.pixels, v.points.ids))
    bricks = len({tuple(place[:3]) for place in mapper.densifier.voxels.marks()[0].tolist()})
    return Mapped(
        mapper.gaussians.to_numpy(),
        [view.index for view in mapper.keyframes],
        mapper.caught(),
        mapper.budget.held(),
        len(mapper.gaussians) * 292 + images + points + bricks * 256,
        mapper.renderer.view_renders,
    )


@pytest.fixture(scope="module")
def free(taichi_on_the_cpu: None) -> Mapped:
    return mapped(None)


@pytest.mark.parametrize("sh_degree", [0, 2])
@pytest.mark.parametrize("real", [ti.f32, ti.f64])
def test_a_gaussian_takes_what_its_fields_hold(taichi_on_the_cpu: None, sh_degree: int, real: object) -> None:
    initialise("cpu")
    gaussians = GaussianField(sh_degree, 1024, real)
    gaussians.append(
        np.zeros((1, 3)), np.zeros((1, 3)), np.eye(4)[:1], np.zeros(1), np.zeros((1, gaussians.sh_count, 3))
    )
    values = sum(array.nbytes for array in gaussians.to_numpy().values())
    # Values, gradients and two moments; four integers; slot, and tangent with its gradient.
    assert gaussians.bytes_each == 4 * values + 4 * 4 + 4 + 2 * 6 * np.dtype(gaussians.dtype).itemsize


def test_the_budget_adds_up_what_the_map_holds(free: Mapped) -> None:
    assert free.held == free.counted


def test_nothing_is_refused_without_a_limit_or_below_it(free: Mapped) -> None:
    assert free.safeguards.warning() is None
    roomy = mapped(free.held / 1e9 * 1.5)
    assert roomy.safeguards.warning() is None
    for name, array in free.gaussians.items():
        np.testing.assert_array_equal(roomy.gaussians[name], array)


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_a_map_ends_within_its_memory_and_says_what_had_no_room(free: Mapped, share: float) -> None:
    limit = share * free.held
    tight = mapped(limit / 1e9)
    assert tight.held <= limit
    assert tight.safeguards.gaussians_without_room > 0 and "mapping.memory" in tight.safeguards.warning()
    assert 0 < len(tight.gaussians["position"]) < len(free.gaussians["position"])
    assert len(tight.keyframes) + tight.safeguards.keyframes_without_room == FRAMES


def test_frames_without_room_go_on_optimising_the_map(free: Mapped) -> None:
    memory = 0.7 * free.held / 1e9
    tight = mapped(memory)
    kept = len(tight.keyframes)
    assert tight.keyframes == list(range(kept)) and 0 < kept < FRAMES
    # The fifth part of two steps, but one at least, for as many views.
    assert tight.renders - mapped(memory, kept).renders == (FRAMES - kept) * VIEWS.per_step


def test_a_frame_without_room_is_no_keyframe(free: Mapped) -> None:
    # Without a Gaussian two frames fit, and a third does not.
    tight = mapped(2.5 * (64 * 48 * 4 + 120 * (24 + 16 + 8)) / 1e9)
    assert tight.keyframes == list(range(len(tight.keyframes))) and len(tight.keyframes) in (1, 2)
    assert tight.safeguards.keyframes_without_room == FRAMES - len(tight.keyframes)


def test_frames_between_keyframes_leave_half_of_the_memory_to_the_map(free: Mapped) -> None:
    taken = []
    for memory in (None, free.held / 1e9, free.held / 4e9):
        initialise("cpu")
        keyframes = {"covisibility": 0.0, "baseline": 9.0, "between": 1}
        settings = MappingSettings(sh_degree=0, optimise={"steps": 1}, keyframes=keyframes, memory=memory)
        mapper = OnlineMapper(settings, 64, 48, seed=1)
        mapper.process(frame(0))
        held, fits = mapper.budget.held(), mapper.keyframes.bytes_of(frame(1))
        mapper.process(frame(1))
        taken.append(len(mapper.keyframes) == 2)
        assert taken[-1] == (memory is None or held + fits <= 0.5e9 * memory)
        assert mapper.caught().keyframes_without_room == 0
    assert taken == [True, True, False]


COUNT = 3_000_000
CHUNK = 250_000
STEPS = 20
DEPTH = 4.0
CAMERA = PinholeCamera(300.0, 300.0, 160.0, 120.0, 320, 240)


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


@pytest.mark.skipif(engine().max_gaussians < COUNT, reason=f"{engine().title} holds fewer Gaussians")
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

"""Maps of parts become one: free space, owners and colours against plain twins, and parts of the wall."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3, inverse_se3
from fields.map.gaussians import SH_C0
from pipelines.render.renderer import Renderer
from pipelines.whole.merge import (
    BEFORE,
    FreeSpace,
    MappedPart,
    Shown,
    ShownSurface,
    colour_changes,
    exposed_in,
    merge,
    owned,
    recoloured,
)
from tests.pipelines import reference
from tests.pipelines.mapped_wall import finished_mapper, fresh_mapper
from tests.pipelines.scenes import CAMERA, NEAR, POSE, random_gaussians
from tests.pipelines.wall import frame

State = dict[str, NDArray[np.float64]]
SIZE = (CAMERA.height, CAMERA.width)


def shown(state: State, view: ShownSurface) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums (N,) of alpha T and of alpha T z / D over the pixels with a surface, by the plain renderer."""
    splats = reference.project(state, CAMERA, view.T_camera_world, NEAR)
    weight, weighted_ratio = np.zeros(len(state["position"])), np.zeros(len(state["position"]))
    T, surface = np.ones(SIZE), view.depth > 0
    for i, alpha in zip(splats.index, splats.alpha(CAMERA.width, CAMERA.height), strict=True):
        drawn = np.where(alpha >= reference.ALPHA_MIN, np.minimum(alpha, reference.ALPHA_MAX), 0.0)
        z = state["position"][i] @ view.T_camera_world[2, :3] + view.T_camera_world[2, 3]
        weight[i] = (drawn * T)[surface].sum()
        weighted_ratio[i] = (drawn * T * z)[surface] @ (1.0 / view.depth[surface])
        T = T * (1 - drawn)
    return weight, weighted_ratio


@pytest.mark.parametrize("seed", range(3))
def test_the_rule_is_that_of_the_plain_twin(renderers: Callable[..., Renderer], seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, numbers = random_gaussians(150, seed), rng.integers(0, 3, 150)
    views = []
    for number in range(3):
        depth = np.where(rng.random(SIZE) < 0.2, 0.0, rng.uniform(3.0, 6.0, SIZE))
        pose = exp_se3(0.1 * rng.normal(size=6)) @ POSE
        views.append(ShownSurface(number, CAMERA, pose, depth))
    before, elsewhere, unsure = np.zeros(150), np.zeros(150), np.zeros(150, dtype=bool)
    for view in views:
        weight, weighted_ratio = shown(state, view)
        is_before = (weighted_ratio < BEFORE * weight) & (numbers != view.number)
        before += np.where(is_before, weight, 0.0)
        elsewhere += np.where(is_before, 0.0, weight)
        unsure |= np.abs(weighted_ratio - BEFORE * weight) < 1e-3 * weight
    unsure |= np.abs(before - elsewhere) < 1e-3 * (before + elsewhere)
    renderer = renderers()
    renderer.gaussians.load(state)
    floating = FreeSpace(renderer, NEAR).floating(numbers, views)
    np.testing.assert_array_equal(floating[~unsure], (before > elsewhere)[~unsure])
    assert unsure.sum() < 10
    assert 20 < floating.sum() < 130


def wall_and_fog() -> State:
    """An opaque wall of 400 small Gaussians, four before the camera, and a large transparent one half-way to it."""
    across, down = np.meshgrid(np.linspace(0, CAMERA.width, 20), np.linspace(0, CAMERA.height, 20))
    pixels = np.append(np.column_stack([across.ravel(), down.ravel()]), [[20.0, 15.0]], axis=0)
    z = np.append(np.full(400, 4.0), 2.0)
    T_world_camera = inverse_se3(POSE)
    return {
        "position": CAMERA.unproject(pixels, z) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3],
        "log_scale": np.log(np.append(np.full((400, 3), 0.15), [[0.5, 0.5, 0.5]], axis=0)),
        "quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (401, 1)),
        "opacity_logit": np.append(np.full(400, 3.0), -1.0),
        "sh": np.zeros((401, 1, 3)),
    }


@pytest.mark.parametrize("of_fog", [0, 1])
def test_fog_before_a_wall_floats_unless_the_map_that_shows_the_wall_has_it(
    renderers: Callable[..., Renderer], of_fog: int
) -> None:
    renderer, state = renderers(), wall_and_fog()
    space = FreeSpace(renderer, NEAR)
    renderer.gaussians.load({name: values[:400] for name, values in state.items()})
    renderer.forward(CAMERA, POSE, NEAR)
    surface = space.surface(0, CAMERA, POSE)
    assert 3.5 < np.median(surface.depth) < 4.1
    renderer.gaussians.load(state)
    floating = space.floating(np.append(np.zeros(400, dtype=int), of_fog), [surface])
    assert not floating[:400].any()
    assert floating[400] == (of_fog == 1)


def transform(rng: np.random.Generator) -> NDArray[np.float64]:
    return np.column_stack([np.eye(3) + 0.1 * rng.normal(size=(3, 3)), 0.05 * rng.normal(size=3)])


def applied(transform: NDArray[np.float64], colours: NDArray[np.float64]) -> NDArray[np.float64]:
    return colours @ transform[:, :3].T + transform[:, 3]


def test_an_image_stays_the_same_when_colours_and_exposure_change() -> None:
    rng = np.random.default_rng(1)
    colours, exposure, change = rng.random((7, 3)), transform(rng), transform(rng)
    image = applied(exposure, colours)
    np.testing.assert_allclose(applied(exposed_in(exposure, change), applied(change, colours)), image, atol=1e-12)


def test_harmonics_change_as_the_colours_that_they_make() -> None:
    rng = np.random.default_rng(2)
    sh, change = rng.normal(size=(5, 4, 3)), transform(rng)
    basis = np.array([SH_C0, *rng.normal(size=3)])  # in one direction
    colours = 0.5 + np.einsum("k,nkc->nc", basis, sh)
    after = 0.5 + np.einsum("k,nkc->nc", basis, recoloured(sh, change))
    np.testing.assert_allclose(after, applied(change, colours), atol=1e-12)


def test_the_changes_are_found_along_a_chain_of_shared_frames() -> None:
    """Maps whose colours are those of the scene after a transform of their own."""
    rng = np.random.default_rng(3)
    of_frame = {index: transform(rng) for index in range(12)}
    of_map = [np.eye(3, 4), transform(rng), transform(rng)]
    frames = [range(5), range(3, 9), range(8, 12)]
    exposures = [{i: exposed_in(of_frame[i], change) for i in own} for own, change in zip(frames, of_map, strict=True)]
    colours = rng.random((4, 3))
    for change, into in zip(of_map, colour_changes(exposures), strict=True):
        np.testing.assert_allclose(applied(into, applied(change, colours)), colours, atol=1e-9)


EDGE = 0.5


def maps(seed: int, count: int = 3, spread: float = 1.2) -> list[Shown]:
    """Maps of random places that overlap. A fifth of the Gaussians does not show."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(20, 60, count)
    return [
        Shown(
            rng.normal([0.6 * number, 0.0, 0.0], spread, (size, 3)),
            np.where(rng.random(size) < 0.2, 0.0, rng.integers(1, 50, size)).astype(np.float32),
        )
        for number, size in enumerate(sizes)
    ]


def plainly_owned(maps: list[Shown], edge: float) -> list[NDArray[np.bool_]]:
    """The rule, for one Gaussian after the other."""

    def cube(position: NDArray[np.floating]) -> tuple[int, ...]:
        return tuple(int(np.floor(c / edge)) for c in position)

    def score(number: int, wanted: tuple[int, ...], reach: int) -> float:
        total = 0.0
        for position, coverage in zip(maps[number].position, maps[number].coverage, strict=True):
            if max(abs(a - b) for a, b in zip(cube(position), wanted, strict=True)) <= reach:
                total += float(coverage)
        return total

    def owner(wanted: tuple[int, ...]) -> int:
        bids = [score(number, wanted, 1) if score(number, wanted, 0) > 0 else 0.0 for number in range(len(maps))]
        return bids.index(max(bids)) if max(bids) > 0 else -1

    return [
        np.array(
            [coverage > 0 and owner(cube(x)) == number for x, coverage in zip(m.position, m.coverage, strict=True)]
        )
        for number, m in enumerate(maps)
    ]


@pytest.mark.parametrize("seed", range(4))
def test_the_owner_is_that_of_the_plain_twin(seed: int) -> None:
    given = maps(seed)
    for found, expected in zip(owned(given, EDGE), plainly_owned(given, EDGE), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_a_place_that_only_one_map_shows_stays_whole() -> None:
    first, second = maps(5, count=2)
    far = Shown(second.position + np.array([100.0, 0.0, 0.0]), second.coverage)
    for kept, each in zip(owned([first, far], EDGE), (first, far), strict=True):
        np.testing.assert_array_equal(kept, each.coverage > 0)


def test_what_lies_at_infinity_is_taken_as_one_cube() -> None:
    near = Shown(np.array([[1e30, 0.0, 0.0], [-1e30, 0.0, 0.0]]), np.array([2.0, 1.0]))
    other = Shown(np.array([[3e30, 0.0, 0.0], [-2e30, 0.0, 0.0]]), np.array([1.0, 2.0]))
    assert [kept.tolist() for kept in owned([near, other], EDGE)] == [[True, False], [False, True]]


FRAMES, CUT = 6, 3


@pytest.mark.slow
def test_of_two_parts_with_the_same_gaussians_each_stays_once() -> None:
    mapper = finished_mapper(FRAMES)
    store, gaussians = mapper.keyframes, mapper.gaussians.to_numpy()
    psnr = [mapper.optimiser.compare(view, store.scene_depth).psnr for view in store]
    parts = [
        MappedPart(
            own=own,
            gaussians=gaussians,
            keyframes=[view.index for view in store.selected],
            poses={index: store.corrected(index, T) for index, T in mapper.trajectory.items()},
            exposures={},
            scene_depth=store.scene_depth,
            view_renders=10,
        )
        for own in (range(CUT), range(CUT, FRAMES))
    ]
    mapper = fresh_mapper()
    kept = merge(mapper, parts, (frame(i) for i in range(FRAMES)))
    given, merged = (set(map(tuple, of["position"].tolist())) for of in (gaussians, mapper.gaussians.to_numpy()))
    assert len(mapper.gaussians) == len(merged) == sum(kept) and min(kept) > 0
    assert merged <= given and len(merged) > 0.9 * len(given)
    store = mapper.keyframes
    # Those that were left out show in no keyframe.
    assert np.min([mapper.optimiser.compare(view, store.scene_depth).psnr for view in store]) > min(psnr) - 0.5
    assert mapper.renderer.view_renders >= 20

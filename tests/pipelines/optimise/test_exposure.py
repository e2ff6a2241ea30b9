"""Exposure: the way back from an image to the scene's colours, the fit, the pull, and a whole run of changing light."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import trim_mean

from fields.frames.tracked_frame import TrackedFrame
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from fields.runtime.backend import initialise
from pipelines.companions.exposure import CHANGED, ExposureRefinement, fitted_gains, light_changes, scene_colours
from pipelines.online import OnlineMapper
from pipelines.render.formulas import IDENTITY
from pipelines.settings import ExposureSettings, MappingSettings
from tests.pipelines.wall import CAMERA, frame

pytestmark = pytest.mark.slow

EXPOSURE = IDENTITY + np.random.default_rng(1).normal(scale=0.05, size=(3, 4))


def keyframe(image: NDArray, vignette: NDArray | None = None, exposure: NDArray | None = None) -> Keyframe:
    tracked = replace(frame(0), image=image.astype(np.float32), vignette=vignette)
    view = KeyframeStore().append(tracked)
    view.exposure = exposure
    return view


def vignette(width: int = CAMERA.width, height: int = CAMERA.height) -> NDArray[np.float32]:
    x, y = np.linspace(-1, 1, width), np.linspace(-1, 1, height)
    return np.repeat((1 - 0.35 * (x**2 + y[:, None] ** 2))[..., None], 3, axis=2).astype(np.float32)


# ---- colours of new Gaussians ----------------------------------------------------------------------------------


def test_the_colours_of_the_scene_are_those_that_develop_into_the_image() -> None:
    scene = np.random.default_rng(2).uniform(0.3, 0.7, (CAMERA.height, CAMERA.width, 3))
    image = (scene @ EXPOSURE[:, :3].T + EXPOSURE[:, 3]) * vignette()
    pixels = np.stack(np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height)), axis=-1).reshape(-1, 2)
    found = scene_colours(keyframe(image, vignette(), EXPOSURE), pixels)
    # Half of a 256th, divided by the vignette and carried through the inverse of A.
    assert np.abs(found.reshape(scene.shape) - scene).max() < 0.5 / 255 / vignette().min() * 1.7


def test_colours_stay_within_bounds_where_the_exposure_cannot_be_undone() -> None:
    image = np.ones((CAMERA.height, CAMERA.width, 3))
    singular = np.array([[1e-9, 0, 0, 0.5], [0, 1e-9, 0, 0.5], [0, 0, 0, 0.5]])
    colours = scene_colours(keyframe(image, exposure=singular), np.zeros((1, 2), dtype=int))
    assert np.isfinite(colours).all()
    assert ((colours >= 0) & (colours <= 2)).all()


# ---- the fit and the pull --------------------------------------------------------------------------------------


def test_the_fit_finds_gains_behind_outliers_and_saturated_pixels() -> None:
    rng = np.random.default_rng(3)
    gains = np.array([1.3, 0.8, 1.1])
    colours = rng.uniform(0, 1, (4000, 3))
    image = np.clip(gains * colours + rng.normal(scale=0.005, size=(4000, 3)), 0, 1)
    image[:800] = rng.uniform(0, 1, (800, 3))
    np.testing.assert_allclose(fitted_gains(colours, image, np.ones(3)), gains, rtol=0.01)


def test_without_news_from_the_image_the_exposure_becomes_a_plain_gain() -> None:
    refinement = ExposureRefinement(ExposureSettings(enabled=True, learning_rate=0.01))
    view = keyframe(np.zeros((CAMERA.height, CAMERA.width, 3)), exposure=EXPOSURE)
    for _ in range(200):
        refinement.step(view, np.zeros((3, 4)))
    np.testing.assert_allclose(view.exposure, np.diagonal(EXPOSURE).mean() * IDENTITY, atol=0.01)


def showing(share: float) -> SimpleNamespace:
    """A renderer whose images show a grey map in the upper share of the image."""
    opacity = np.zeros((CAMERA.height, CAMERA.width))
    opacity[: round(share * CAMERA.height)] = 1.0
    images = SimpleNamespace(
        opacity_to_numpy=lambda: opacity, colour_to_numpy=lambda: np.full((*opacity.shape, 3), 0.5)
    )
    return SimpleNamespace(forward=lambda *_: None, images=images)


def keyframes(ids: tuple[int, ...], *exposures: NDArray | None) -> KeyframeStore:
    """Keyframes with these exposures, each of which tracks points with the ids of a frame."""
    store = KeyframeStore()
    for index, (of, exposure) in enumerate(zip(ids, exposures, strict=True)):
        store.append(replace(frame(index), points=replace(frame(index).points, ids=frame(of).points.ids)))
        store[-1].exposure = exposure
    return store


@pytest.mark.parametrize(("ids", "own"), [((0, 0, 2), True), ((0, 0, 0), False), ((0, 1, 2), False)])
@pytest.mark.parametrize(("enabled", "begins_with"), [(True, IDENTITY), ("auto", None), (False, None)])
def test_a_keyframe_that_sees_nothing_of_the_map_begins_anew_only_at_a_place_of_its_own(
    ids: tuple[int, ...], own: bool, enabled: bool | str, begins_with: NDArray | None
) -> None:
    """If no id ever returns, none tells of a new place."""
    store = keyframes(ids, EXPOSURE, EXPOSURE, EXPOSURE)
    ExposureRefinement(ExposureSettings(enabled=enabled)).new_keyframe(store, showing(share=0.0), 0.01)
    np.testing.assert_array_equal(store[-1].exposure, begins_with if own else EXPOSURE)
    assert (store[-1].index in store.begins) == own


@pytest.mark.parametrize(("share", "own"), [(0.1, True), (0.5, False)])
def test_fringes_of_an_earlier_place_are_no_return_to_it(share: float, own: bool) -> None:
    store = keyframes((0, 0, 2), EXPOSURE, EXPOSURE, EXPOSURE)
    ExposureRefinement(ExposureSettings(enabled=True)).new_keyframe(store, showing(share), 0.01)
    assert (store[-1].index in store.begins) == own


def test_exposures_of_a_new_place_are_estimated_once_its_light_changes() -> None:
    """The wall of keyframes 2 to 4 is another place. It begins darker than keyframe 1, but changes only in the last."""
    store = KeyframeStore()
    refinement = ExposureRefinement(ExposureSettings(enabled="auto"))
    for index, (gain, share) in enumerate([(1.0, 1.0), (1.0, 1.0), (0.6, 0.0), (0.6, 1.0), (0.9, 1.0)]):
        points = replace(frame(index).points, ids=frame(0).points.ids + 100_000 * (index >= 2))
        store.append(replace(frame(index), image=np.float32(gain) * frame(index).image, points=points))
        if index < 2:
            store[index].exposure = EXPOSURE
        else:
            refinement.new_keyframe(store, showing(share), 0.01)
        if index == 3:
            assert [view.exposure is None for view in store] == [False, False, True, True]
    assert [view.index in store.begins for view in store] == [False, False, True, False, False]
    for view, exposure in zip(store, [EXPOSURE, EXPOSURE, IDENTITY, IDENTITY], strict=False):
        np.testing.assert_array_equal(view.exposure, exposure)
    gain = np.median(store[-1].rgba[..., :3] / 255.0 / 0.5, axis=(0, 1))
    np.testing.assert_allclose(store[-1].exposure, np.column_stack([np.diag(gain), np.zeros(3)]), atol=0.02)


@pytest.mark.parametrize("estimated_there", [True, False])
def test_back_at_an_earlier_place_exposures_are_estimated_if_they_were_there(estimated_there: bool) -> None:
    """Ten keyframes lie between, and none of them tracks a point of the first or the last."""
    store = keyframes((0, *[1] * 10, 0), EXPOSURE if estimated_there else None, *[None] * 11)
    store.begins.add(store[1].index)
    ExposureRefinement(ExposureSettings(enabled="auto")).new_keyframe(store, showing(1.0), 0.01)
    assert [view.index in store.begins for view in store] == [False, True, *[False] * 10]
    assert [view.exposure is not None for view in store] == [estimated_there] * 12


# ---- whole runs on the wall of test_mapping --------------------------------------------------------------------

GAINS = (1.0, 0.8, 1.15, 0.9, 0.7, 1.0, 0.85)


def changing() -> list:
    frames = [frame(i) for i in range(len(GAINS))]
    return [replace(f, image=np.clip(g * f.image, 0, 1)) for f, g in zip(frames, GAINS, strict=True)]


def mapped(frames: list, **exposure: object) -> OnlineMapper:
    settings = MappingSettings(
        optimise={"steps": 20},
        densify={"warm_up": 2},
        keyframes={"max_gap": 1},
        exposure=exposure,
        gate={"enabled": False},  # a scene of one colour looks the same from everywhere
    )
    initialise("cpu")  # one process does not hold all these maps
    mapper = OnlineMapper(settings, CAMERA.width, CAMERA.height, seed=1)
    for each in frames:
        mapper.process(each)
    mapper.finish()
    return mapper


@pytest.mark.parametrize("enabled", [True, "auto"])
def test_the_gains_of_keyframes_are_found(taichi_on_the_cpu: None, enabled: bool | str) -> None:
    mapper = mapped(changing(), enabled=enabled)
    assert len(mapper.keyframes) == len(GAINS)
    for view, gain in zip(mapper.keyframes, GAINS, strict=True):
        shown = view.exposure @ [0.5, 0.5, 0.5, 1.0]
        np.testing.assert_allclose(shown, 0.5 * gain / np.exp(trim_mean(np.log(GAINS), 0.25)), atol=0.03)


def test_a_dark_first_image_does_not_darken_the_map(taichi_on_the_cpu: None) -> None:
    frames = [frame(i) for i in range(len(GAINS))]
    dark = replace(frames[0], image=0.25 * frames[0].image)
    shown = []
    for recording, enabled in ((frames, True), ([dark, *frames[1:]], "auto")):
        mapper = mapped(recording, enabled=enabled)
        shown.append(mapper.renderer.render(CAMERA, mapper.keyframes[3].T_camera_world, 0.01))
    solid = (shown[0].opacity > 0.9) & (shown[1].opacity > 0.9)
    bright, expected = shown[1].colour[solid].mean(axis=0), shown[0].colour[solid].mean(axis=0)
    np.testing.assert_allclose(bright, expected, rtol=0.02)
    np.testing.assert_allclose(np.diag(mapper.keyframes[0].exposure), 0.25, rtol=0.1)


def test_moving_the_zero_leaves_every_picture_as_it_was(taichi_on_the_cpu: None) -> None:
    mapper = mapped(changing(), enabled=True)
    depth = mapper.keyframes.scene_depth
    for view in mapper.keyframes:
        view.exposure = np.diag([2.0, 3.0, 0.5]) @ view.exposure
    before = [mapper.optimiser.compare(view, depth).l1 for view in mapper.keyframes]
    mapper.zero.hold()
    # An offset of the colours is lost where the black background shows.
    assert [mapper.optimiser.compare(view, depth).l1 for view in mapper.keyframes] == pytest.approx(before, rel=1e-3)
    gains = [np.diag(view.exposure) for view in mapper.keyframes]
    np.testing.assert_allclose(trim_mean(np.log(gains), 0.25), 0.0, atol=1e-9)


def test_the_zero_stays_while_a_place_has_no_exposures(taichi_on_the_cpu: None) -> None:
    mapper = mapped(changing(), enabled=True)
    for view in list(mapper.keyframes)[:4]:
        view.exposure = 2.0 * view.exposure
    before = mapper.gaussians.to_numpy()["sh"]
    mapper.keyframes[-1].exposure = None
    mapper.zero.hold()
    np.testing.assert_array_equal(mapper.gaussians.to_numpy()["sh"], before)


def test_the_exposure_of_the_first_keyframe_of_a_further_place_is_fixed(taichi_on_the_cpu: None) -> None:
    mapper = mapped(changing(), enabled=True)
    mapper.keyframes.begins.add(mapper.keyframes[1].index)
    before = [view.exposure for view in mapper.keyframes]
    views = list(range(len(before)))
    mapper.optimiser.step(mapper.keyframes, views, mapper.optimiser.rates(mapper.keyframes.scene_depth), pose_rate=0.0)
    mapper.optimiser.settle()
    moved = [not np.array_equal(view.exposure, old) for view, old in zip(mapper.keyframes, before, strict=True)]
    assert moved == [True, False, *[True] * (len(before) - 2)]


def test_no_exposure_is_estimated_in_a_light_that_does_not_change(taichi_on_the_cpu: None) -> None:
    mapper = mapped([frame(i) for i in range(len(GAINS))], enabled="auto")
    assert len(mapper.keyframes) == len(GAINS)
    assert all(view.exposure is None for view in mapper.keyframes)


@pytest.mark.parametrize("known", [True, False])
def test_a_scene_of_one_colour_is_recovered_behind_a_known_vignette(taichi_on_the_cpu: None, known: bool) -> None:
    colour = np.array([0.5, 0.6, 0.4])
    frames = [
        replace(frame(i), image=(colour * vignette()).astype(np.float32), vignette=vignette() if known else None)
        for i in range(4)
    ]
    mapper = mapped(frames, enabled=False)
    view = mapper.keyframes[1]
    scene = mapper.renderer.render(view.camera, view.T_camera_world, 0.01)
    solid = scene.opacity > 0.9
    assert solid.mean() > 0.2
    shown = (scene.colour / colour).mean(axis=2) / np.maximum(scene.opacity, 0.1)
    light = vignette()[..., 0]
    corners, middle = shown[solid & (light < 0.65)], shown[solid & (light > 0.9)]
    assert min(len(corners), len(middle)) > 100
    fall = corners.mean() / middle.mean()
    # Without the vignette the map takes the dark corners for the scene's.
    assert fall == pytest.approx(1.0, abs=0.03) if known else fall < 0.75
    # Nobody asked for exposures.
    assert all(view.exposure is None for view in mapper.keyframes)
    assert mapper.keyframes.exposure_at(0) is None


def brightened(i: int, gain: float) -> TrackedFrame:
    f = frame(i)
    return replace(f, image=np.clip(gain * f.image, 0, 1).astype(np.float32))


def store_of(frames: list[TrackedFrame]) -> KeyframeStore:
    store = KeyframeStore()
    for each in frames:
        store.append(each)
    return store


def test_a_wall_in_constant_light_does_not_change() -> None:
    for last in range(1, 7):
        assert not light_changes(store_of([frame(i) for i in range(last + 1)]))


@pytest.mark.parametrize("gain", [0.5, 0.8, 1.2])
def test_a_brighter_or_darker_image_is_a_change(gain: float) -> None:
    assert light_changes(store_of([frame(0), frame(1), brightened(2, gain)]))


def test_the_light_of_an_earlier_place_does_not_count() -> None:
    store = store_of([frame(0), frame(1), brightened(2, 0.5)])
    store.begins.add(store[2].index)
    assert not light_changes(store)
    store.append(brightened(3, 0.5))
    assert not light_changes(store)
    store.append(frame(4))
    assert light_changes(store)


def test_a_slow_drift_adds_up_over_several_keyframes() -> None:
    step = np.exp(0.4 * CHANGED)
    assert not light_changes(store_of([frame(0), brightened(1, step)]))
    assert light_changes(store_of([brightened(i, step**i) for i in range(6)]))


def test_a_thing_that_hides_a_third_of_the_points_is_no_change() -> None:
    hidden = frame(1)
    image = hidden.image.copy()
    image[:, : CAMERA.width // 3] = 0.9
    assert not light_changes(store_of([frame(0), replace(hidden, image=image)]))

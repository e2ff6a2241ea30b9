"""Objects whose fields are gone, or for which there is no room, say so; any thread may use the others."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera
from fields.map.gaussians import GaussianField
from fields.runtime.backend import initialise
from fields.runtime.engine import TAICHI, engine
from fields.runtime.tenancy import ensure_started
from fields.voxels.occupancy import OccupancyVoxels
from pipelines.online import OnlineMapper
from pipelines.refinement import refine
from pipelines.render.renderer import Renderer
from pipelines.settings import MappingSettings, RefineSettings
from pipelines.state import save_state
from tests.pipelines.wall import frame

CAMERA = PinholeCamera(16.0, 16.0, 8.0, 8.0, 16, 16)
POINT = [[0.1, 0.2, 2.0]]


@pytest.fixture(autouse=True)
def started(taichi_on_the_cpu: None) -> Iterator[None]:
    initialise("cpu")
    yield
    gc.collect()


def gaussians(count: int = 1) -> GaussianField:
    field = GaussianField(0, 1024)
    field.append(
        np.tile([0.0, 0.0, 2.0], (count, 1)),
        np.full((count, 3), -1.0),
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.zeros(count),
        np.ones((count, 1, 3)),
    )
    return field


def in_thread(work: Callable[[], object]) -> object:
    """The result of `work` in a thread of its own, or what it raised."""
    results: list[object] = []

    def run() -> None:
        try:
            results.append(work())
        except Exception as error:
            results.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    return results[0]


def mapper() -> OnlineMapper:
    return OnlineMapper(MappingSettings(), 64, 48)


# What makes an object, and returns a use of it.
USES: dict[str, Callable[[], Callable[[], object]]] = {
    "voxels": lambda: partial(OccupancyVoxels().admit, POINT, 0.1),
    "marks": lambda: OccupancyVoxels().marks,
    "values": lambda: gaussians().to_numpy,
    "removal": lambda: partial(gaussians().remove, np.zeros(1, dtype=bool)),
    "picture": lambda: partial(Renderer(gaussians(), 16, 16).render, CAMERA, np.eye(4), 0.01),
    "forward": lambda: partial(Renderer(gaussians(), 16, 16).forward, CAMERA, np.eye(4), 0.01),
    "backward": lambda: Renderer(gaussians(), 16, 16).backward,
    "frame": lambda: partial(mapper().process, frame(0)),
    "refinement": lambda: partial(refine, mapper(), RefineSettings()),
    "state": lambda: partial(save_state, mapper()),
}


@pytest.mark.parametrize("kind", USES)
def test_what_a_new_start_has_freed_is_refused_in_one_line(kind: str) -> None:
    use = USES[kind]()
    initialise("cpu")
    with pytest.raises(RuntimeError) as refused:
        use()
    assert "\n" not in str(refused.value)
    assert OccupancyVoxels().admit(POINT, 0.1).all()  # and nothing else is harmed


@pytest.mark.skipif(engine() is not TAICHI, reason="only Taichi has this limit")
@pytest.mark.parametrize(
    "another",
    [OccupancyVoxels, gaussians, mapper],
    ids=["voxels", "Gaussians", "map"],
)
def test_what_finds_no_room_leaves_the_others_as_they_are(another: Callable[[], object]) -> None:
    first, second = OccupancyVoxels(), OccupancyVoxels()
    first.admit(POINT, 0.1)
    for _ in range(2):
        with pytest.raises(RuntimeError, match=r"^[^\n]+$"):
            another()
    assert first.query(POINT, 0.1).all() and not second.query(POINT, 0.1).any()
    assert second.admit(POINT, 0.1).all()


def test_what_is_closed_or_forgotten_makes_room_for_the_next() -> None:
    for _ in range(3):
        with OccupancyVoxels() as voxels:
            assert voxels.admit(POINT, 0.1).all()
        voxels.close()  # again
        with pytest.raises(RuntimeError, match=r"^[^\n]+$"):
            voxels.query(POINT, 0.1)
    for _ in range(3):
        assert OccupancyVoxels().admit(POINT, 0.1).all()


def test_what_fails_while_it_is_made_harms_nothing() -> None:
    field = gaussians()
    for size in (64.5, "64", None):
        with pytest.raises((TypeError, ValueError)):
            Renderer(field, size, 48)
    assert Renderer(field, 16, 16).render(CAMERA, np.eye(4), 0.01).opacity.max() > 0.4


def test_any_thread_makes_and_uses_them() -> None:
    expected = Renderer(gaussians(), 16, 16).render(CAMERA, np.eye(4), 0.01).colour
    made = in_thread(lambda: Renderer(gaussians(), 16, 16))
    assert isinstance(made, Renderer)
    for use in (in_thread, lambda work: work()):
        np.testing.assert_array_equal(use(lambda: made.render(CAMERA, np.eye(4), 0.01).colour), expected)


def test_threads_wait_for_one_another() -> None:
    renderers = [Renderer(gaussians(count), 16, 16) for count in (1, 3)]
    expected = [renderer.render(CAMERA, np.eye(4), 0.01).colour for renderer in renderers]
    found: list[tuple[int, np.ndarray]] = []

    def draw(place: int) -> None:
        for _ in range(20):
            found.append((place, renderers[place].render(CAMERA, np.eye(4), 0.01).colour))

    threads = [threading.Thread(target=draw, args=[number % 2]) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 80
    for place, colour in found:
        np.testing.assert_array_equal(colour, expected[place])


def test_the_engine_may_be_started_in_any_thread() -> None:
    assert in_thread(lambda: initialise("cpu")) == "cpu"
    assert in_thread(lambda: OccupancyVoxels().admit(POINT, 0.1).all())
    assert OccupancyVoxels().admit(POINT, 0.1).all()


def test_an_engine_in_use_is_shared_and_not_started_again() -> None:
    voxels = OccupancyVoxels()
    voxels.admit(POINT, 0.1)
    assert ensure_started("auto") == ensure_started("cpu") == "cpu"
    assert voxels.query(POINT, 0.1).all()
    with pytest.raises(RuntimeError, match=r"^[^\n]+$"):
        ensure_started("vulkan")
    assert voxels.query(POINT, 0.1).all()

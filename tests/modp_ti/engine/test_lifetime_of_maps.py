"""Maps that come and go, in any thread, and next to a locator."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from fields.frames.pose_correction import PoseCorrection
from fields.runtime.backend import initialise
from modp_ti.engine.mapper import Mapper
from modp_ti.files.errors import InputError
from modp_ti.outputs.locating.locator import Locator
from pipelines.settings import MappingSettings
from tests.modp_ti.outputs.locating.painted_room import CAMERA as ROOM_CAMERA
from tests.modp_ti.outputs.locating.painted_room import photograph, write_run
from tests.pipelines.wall import CAMERA, frame
from tests.room import Room, walk

SETTINGS = MappingSettings(optimise={"steps": 10}, densify={"warm_up": 2}, depth={"sources": ["image"]})


@pytest.fixture(autouse=True)
def anew(taichi_on_the_cpu: None) -> Iterator[None]:
    initialise("cpu")
    yield


def test_a_correction_before_the_first_frame_is_refused() -> None:
    with Mapper(64, 48, SETTINGS) as fresh, pytest.raises(InputError, match="before it has come"):
        fresh.correct(PoseCorrection(0, np.eye(4)))


@pytest.mark.slow
def test_a_map_grows_in_one_thread_while_another_looks_at_it() -> None:
    with ThreadPoolExecutor(2) as pool:
        made = pool.submit(Mapper, 64, 48, SETTINGS, 1).result()
        grown = pool.submit(lambda: [made.add(frame(i)) for i in range(5)])
        while not grown.done():
            assert np.isfinite(made.render(CAMERA, np.eye(4)).colour).all()
        grown.result()
    found = made.version().gaussians
    initialise("cpu")
    alone = Mapper(64, 48, SETTINGS, 1)
    for i in range(5):
        alone.add(frame(i))
    for name, values in alone.version().gaussians.items():
        np.testing.assert_array_equal(found[name], values)
    with pytest.raises(RuntimeError, match=r"^[^\n]+$"):
        made.save("nowhere")


@pytest.mark.slow
def test_maps_follow_one_another_in_callback_threads() -> None:
    def work() -> float:
        with Mapper(64, 48, SETTINGS) as mapper:
            mapper.add(frame(0))
            return mapper.render(CAMERA).opacity.max()

    for _ in range(2):  # without a new start
        assert asyncio.run(asyncio.to_thread(work)) > 0.5


@pytest.mark.slow
def test_a_map_grows_next_to_a_locator(
    made_once: Callable[[str, Callable[[Path], None]], Path], room: Room, tmp_path: Path
) -> None:
    out = made_once("a painted room", lambda folder: (write_run(room, folder / "out", -0.08), None)[1]) / "out"
    T = walk(13, step=0.1)[4]
    picture = photograph(room, ROOM_CAMERA, T, -0.08)
    mapper = Mapper(64, 48, SETTINGS)
    mapper.add(frame(0))
    before = mapper.render(CAMERA).colour
    with Locator(out) as locator:
        location = locator.locate(picture)
        assert location.T_camera_world is not None
        np.testing.assert_allclose(location.T_camera_world, T, atol=0.2)
        np.testing.assert_array_equal(mapper.render(CAMERA).colour, before)
        mapper.add(frame(1))
        np.testing.assert_array_equal(locator.locate(picture).T_camera_world, location.T_camera_world)
    with pytest.raises(RuntimeError, match=r"^[^\n]+$"):
        locator.locate(picture)
    assert mapper.save(tmp_path / "map").is_dir()

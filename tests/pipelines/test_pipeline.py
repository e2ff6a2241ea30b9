"""What drives a map sees one class: the offline baseline takes the defaults of what only the online loop can do."""

from __future__ import annotations

import pytest

from fields.runtime.backend import initialise
from modp_ti.engine.mapper import Mapper
from modp_ti.files.errors import InputError
from modp_ti.inputs.delivered_frames import DeliveredFrames
from pipelines.pipeline import NothingToMapError
from pipelines.settings import OfflineSettings
from pipelines.state import MapState
from tests.pipelines.wall import frame

pytestmark = pytest.mark.slow


@pytest.fixture
def mapper() -> Mapper:
    initialise("cpu")  # which frees the map of the test before
    return Mapper(64, 48, OfflineSettings(steps=3, max_gaussians=4096))


def test_an_offline_map_has_no_budget_and_is_neither_refined_nor_resumed(mapper: Mapper) -> None:
    assert mapper.pipeline.refused == {}
    assert mapper.pipeline.takes_observations(10**9)
    mapper.pipeline.count_beside(10**12)
    with pytest.raises(ValueError):
        mapper.refine(5)
    with pytest.raises(ValueError):
        _ = mapper.online
    with pytest.raises(ValueError):
        mapper.restore(MapState.of({}, {}), DeliveredFrames(), [], finished=True)


def test_a_map_of_nothing_is_said_to_be_one(mapper: Mapper) -> None:
    with pytest.raises(NothingToMapError):
        mapper.pipeline.finish()
    mapper.add(frame(0, held_out=True))
    with pytest.raises(InputError, match="mode: offline"):
        mapper.finish()


def test_finishing_makes_the_map(mapper: Mapper) -> None:
    steps: list[int] = []
    for i in range(1, 4):
        mapper.add(frame(i))
    mapper.finish(lambda step, gaussians, psnr: steps.append(step))
    assert steps == [1, 2, 3] and len(mapper.pipeline.gaussians) > 0

"""Settings, the breakdown of time, and the one interface of the online and the offline mapper."""

from __future__ import annotations

import pytest
from pydantic import BaseModel, ValidationError

from fields.runtime.backend import initialise
from fields.runtime.engine import engine
from modp_ti.engine.mapper import Mapper
from modp_ti.files.errors import InputError
from modp_ti.inputs.delivered_frames import DeliveredFrames
from pipelines.pipeline import NothingToMapError, breakdown_percent
from pipelines.settings import DensifySettings, MappingSettings, OfflineSettings, RefineSettings, StrictModel
from pipelines.state import MapState
from tests.pipelines.wall import frame


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [(DensifySettings, "initial_opacity", 1.0), (RefineSettings, "steps", -1), (MappingSettings, "sh_degree", 4)],
)
def test_values_out_of_bounds_are_errors(section: type[BaseModel], key: str, value: float) -> None:
    with pytest.raises(ValidationError, match=key):
        section(**{key: value})


@pytest.mark.parametrize(
    ("section", "most"),
    [(MappingSettings, engine().max_gaussians), (OfflineSettings, engine().max_gaussians_offline)],
)
def test_a_pool_beyond_what_the_engine_holds_is_refused(section: type[StrictModel], most: int) -> None:
    assert section(max_gaussians=most).max_gaussians == most
    with pytest.raises(ValueError, match=f"{most:,}"):
        section(max_gaussians=most + 1)


def test_the_breakdown_is_the_share_of_each_stage() -> None:
    seconds = {"optimise": 8.0, "select": 0.5, "depth": 0.25, "read": 1.0, "refine": 99.0}
    expected = {"optimise": 80.0, "select": 5.0, "depth": 2.5, "occupancy": 0.0, "others": 12.5}
    assert breakdown_percent(seconds, 10.0) == expected


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

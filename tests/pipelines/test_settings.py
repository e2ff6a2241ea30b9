from __future__ import annotations

import pytest
from pydantic import BaseModel, ValidationError

from fields.runtime.engine import engine
from pipelines import settings
from pipelines.settings import DensifySettings, MappingSettings, OfflineSettings, RefineSettings, StrictModel

SECTIONS = [
    model for model in vars(settings).values() if isinstance(model, type) and issubclass(model, settings.StrictModel)
]


@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.__name__)
def test_every_key_says_what_it_means(section: type[BaseModel]) -> None:
    assert issubclass(section, StrictModel)
    for name, field in section.model_fields.items():
        nested = isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
        assert nested or field.description, name


@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.__name__)
def test_the_defaults_satisfy_their_own_bounds(section: type[BaseModel]) -> None:
    assert section(**section().model_dump()) == section()


def test_an_unknown_key_is_an_error_that_names_it() -> None:
    with pytest.raises(ValidationError, match=r"densify\.pixel"):
        MappingSettings(densify={"pixel": 3})


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [(DensifySettings, "initial_opacity", 1.0), (RefineSettings, "steps", -1), (MappingSettings, "sh_degree", 4)],
)
def test_values_out_of_bounds_are_errors(section: type[BaseModel], key: str, value: float) -> None:
    with pytest.raises(ValidationError, match=key):
        section(**{key: value})


def test_settings_do_not_change_under_way() -> None:
    with pytest.raises(ValidationError, match="near"):
        MappingSettings().near = 1.0


@pytest.mark.parametrize(
    ("section", "most"),
    [(MappingSettings, engine().max_gaussians), (OfflineSettings, engine().max_gaussians_offline)],
)
def test_a_pool_beyond_what_the_engine_holds_is_refused(section: type[StrictModel], most: int) -> None:
    assert section(max_gaussians=most).max_gaussians == most
    with pytest.raises(ValueError, match=f"{most:,}"):
        section(max_gaussians=most + 1)

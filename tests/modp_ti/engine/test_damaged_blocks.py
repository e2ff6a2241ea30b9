"""A file of blocks that is damaged while a map is made."""

from __future__ import annotations

import pytest

from fields.runtime.backend import initialise
from modp_ti.engine.mapper import Mapper
from pipelines.companions.block_files import BlockError
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from tests.pipelines.wall import walked_along

SETTINGS = MappingSettings(sh_degree=0, optimise={"steps": 1}, densify={"warm_up": 2}, max_gaussians=3072)


def test_the_frame_at_which_it_is_found_belongs_to_the_map_without_it() -> None:
    initialise("cpu")
    mapper = Mapper(64, 48, SETTINGS, seed=1)
    for index in range(13):
        mapper.add(walked_along(index, index))
    assert isinstance(mapper.pipeline, OnlineMapper)
    file = next(iter(mapper.pipeline.paging.away)).stored.path
    file.write_bytes(bytes(file.stat().st_size))
    with pytest.raises(BlockError, match=f"{file}: a block of the map is damaged"):
        for index in range(13, 26):
            mapper.add(walked_along(index, 25 - index))
    index = len(mapper.frames) - 1
    assert 13 <= index < 26 and mapper.frames.name[-1] == f"{index}"
    while True:
        try:
            version = mapper.version()
            break
        except BlockError:  # the next of that file
            continue
    assert len(version.trajectory) == len(mapper.frames)

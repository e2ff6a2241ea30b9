"""Occupancy voxels answer any sequence of questions as sets of cells do."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fields.voxels import occupancy
from fields.voxels.occupancy import OccupancyVoxels

LEVELS = 4
# Middles of the finest level's cells, of edge 1/8: no place lies on the border of two.
places = st.tuples(*[st.integers(-40, 39)] * 3).map(lambda cell: tuple((c + 0.5) / 8 for c in cell))
sizes = st.sampled_from([2.0, 1.0, 0.9, 0.5, 0.3, 0.25, 0.2, 0.125, 0.1])
steps = st.lists(
    st.tuples(st.sampled_from(["update", "query", "admit", "rest"]), st.lists(places, min_size=1, max_size=12), sizes),
    min_size=1,
    max_size=8,
)


@pytest.fixture(scope="module", params=["sparse", "hashed"])
def voxels(taichi_on_the_cpu: None, request: pytest.FixtureRequest) -> OccupancyVoxels:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(occupancy, "has_sparse_fields", lambda: request.param == "sparse")
        return OccupancyVoxels(1.0, levels=LEVELS, resolution=64)


def cells_of(place: tuple[float, ...], size: float) -> set[tuple[int, ...]]:
    """The cell of each level from the coarsest, of edge 1, to the finest that is as large as `size`."""
    edges = [edge for edge in (1.0, 0.5, 0.25, 0.125) if edge >= size] or [1.0]
    return {(round(1 / edge), *(int(np.floor(x / edge)) for x in place)) for edge in edges}


@settings(
    derandomize=True,
    max_examples=40,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(sequence=steps)
def test_any_sequence_is_answered_as_by_sets(voxels: OccupancyVoxels, sequence) -> None:
    voxels.clear()
    marked: set[tuple[int, ...]] = set()
    for what, batch, size in sequence:
        xyz = np.array(batch)
        if what == "rest":
            voxels.rest(xyz)
        elif what == "update":
            voxels.update(xyz, size)
            marked |= set().union(*(cells_of(place, size) for place in batch))
        elif what == "query":
            assert voxels.query(xyz, size).tolist() == [cells_of(place, size) <= marked for place in batch]
        else:
            expected = []
            for place in batch:
                expected.append(not cells_of(place, size) <= marked)
                marked |= cells_of(place, size)
            assert voxels.admit(xyz, size).tolist() == expected

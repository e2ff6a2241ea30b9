"""Occupancy voxels, and laws that hold for any points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fields.runtime.backend import initialise
from fields.voxels import hashed_bricks, occupancy, sparse_bricks
from fields.voxels.occupancy import OccupancyVoxels

FORMS = ["cpu", "gpu", "hashed"]


def use(form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the voxels of a form from here on: the kernels of all forms run on the CPU as well."""
    monkeypatch.setattr(occupancy, "has_sparse_fields", lambda: form != "hashed")
    monkeypatch.setattr(sparse_bricks, "on_gpu", lambda: form == "gpu")
    # The hash table grows in every test with more than two bricks.
    monkeypatch.setattr(hashed_bricks, "FIRST_ROOM", 2)


@pytest.fixture(params=FORMS)
def voxels(
    taichi_on_the_cpu: None, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., OccupancyVoxels]:
    """Fresh voxels of each form: Taichi is started anew, since fields cannot be freed one by one."""
    initialise("cpu")
    use(request.param, monkeypatch)
    return OccupancyVoxels


class PlainVoxels:
    """The paper's structure as Python sets of cells, one a level."""

    def __init__(self, coarsest: float, levels: int) -> None:
        self.sizes = [coarsest / 2**k for k in range(levels)]
        self.cells: list[set[tuple[int, ...]]] = [set() for _ in range(levels)]

    def _levels(self, size: float) -> range:
        return range(max(sum(s >= size for s in self.sizes), 1))

    def _cell(self, p: NDArray, level: int) -> tuple[int, ...]:
        return tuple(int(v) for v in np.floor(p / self.sizes[level]))

    def occupied(self, p: NDArray, size: float) -> bool:
        return all(self._cell(p, k) in self.cells[k] for k in self._levels(size))

    def mark(self, p: NDArray, size: float) -> None:
        for k in self._levels(size):
            self.cells[k].add(self._cell(p, k))

    def admit(self, p: NDArray, size: float) -> bool:
        if self.occupied(p, size):
            return False
        self.mark(p, size)
        return True


def test_batches_of_mixed_sizes_are_answered_as_by_plain_sets(voxels: Callable[..., OccupancyVoxels]) -> None:
    # Nine levels: three stacks of bricks, the coarsest stack of one level only.
    ours, plain = voxels(1.0, levels=9, resolution=64), PlainVoxels(1.0, 9)
    rng = np.random.default_rng(1)
    seen = set()
    for _ in range(4):
        # Half of the points lie near others, so that cells are shared on every level.
        centres = rng.uniform(-2, 2, (60, 3))
        near = np.repeat(centres, 10, axis=0) + rng.normal(size=(600, 3)) * 10 ** rng.uniform(-3, 0, (600, 1))
        points = rng.permutation(np.concatenate([rng.uniform(-2, 2, (600, 3)), near]))
        marked, asked, added = 2.0 ** rng.uniform(-9, 1, (3, len(points)))
        ours.update(points[:300], marked[:300])
        for p, size in zip(points[:300], marked[:300], strict=True):
            plain.mark(p, size)
        expected = [plain.occupied(p, size) for p, size in zip(points, asked, strict=True)]
        assert ours.query(points, asked).tolist() == expected
        seen |= {(int(level), occupied) for level, occupied in zip(ours.level_of(asked), expected, strict=True)}
        expected = [plain.admit(p, size) for p, size in zip(points, added, strict=True)]
        assert ours.admit(points, added).tolist() == expected
    assert seen == {(level, occupied) for level in range(9) for occupied in (False, True)}


def test_the_order_of_a_batch_decides_and_not_the_threads(voxels: Callable[..., OccupancyVoxels]) -> None:
    points = np.random.default_rng(2).uniform(-0.2, 0.2, (20_000, 3))
    admitted = voxels(0.1, levels=3, resolution=64).admit(points, 0.05)
    # The oracle: the first point of each cell of the asked level, which alone decides where nothing was marked before.
    _, first = np.unique(np.floor(points / 0.05), axis=0, return_index=True)
    assert np.flatnonzero(admitted).tolist() == sorted(first.tolist())


@pytest.mark.parametrize("levels", [3, 15])
def test_places_that_are_no_numbers_are_never_free(voxels: Callable[..., OccupancyVoxels], levels: int) -> None:
    v = voxels(1.0, levels=levels, resolution=8)
    nowhere = [[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [0.0, 0.0, -np.inf]]
    assert not v.admit(nowhere, 0.5).any()
    assert v.query(nowhere, 0.5).all()
    assert not v.query([[0.1, 0.1, 0.1]], 0.5).any()


def test_an_update_marks_up_to_its_level_and_no_finer_one(voxels: Callable[..., OccupancyVoxels]) -> None:
    v = voxels(1.0, levels=4, resolution=8)
    p = [[0.1, 0.1, 0.1]]
    v.update(p, 0.5)
    assert [bool(v.query(p, size)[0]) for size in (1.0, 0.5, 0.25, 0.125)] == [True, True, False, False]


def test_cells_are_as_wide_on_both_sides_of_the_origin(voxels: Callable[..., OccupancyVoxels]) -> None:
    v = voxels(1.0, levels=1, resolution=8)
    v.update([[0.5, 0.5, 0.5]], 1.0)
    near = [[0.01, 0.5, 0.5], [0.99, 0.5, 0.5], [-0.01, 0.5, 0.5], [0.5, -0.01, 0.5], [1.01, 0.5, 0.5]]
    assert v.query(near, 1.0).tolist() == [True, True, False, False, False]


def test_nothing_repeats_over_the_whole_extent(voxels: Callable[..., OccupancyVoxels]) -> None:
    v = voxels(0.05, levels=8, resolution=512)
    v.update([[0.0, 0.0, 0.0]], 0.0001)
    finest = 0.05 / 128
    offsets = np.array([1, 2, 8, 64, 512, 4096, 8192, 32767])
    for axis in range(3):
        points = np.zeros((2 * len(offsets), 3))
        points[:, axis] = np.concatenate([offsets, -offsets]) * finest + finest / 2
        assert not v.query(points, finest).any()


def test_two_points_of_one_batch_in_one_cell_keep_the_first(voxels: Callable[..., OccupancyVoxels]) -> None:
    v = voxels(1.0, levels=3, resolution=8)
    batch = [[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [0.6, 0.1, 0.1], [0.15, 0.1, 0.1]]
    assert v.admit(batch, 0.25).tolist() == [True, False, True, False]
    assert not v.admit(batch, 0.25).any()


def test_sizes_beyond_every_level_are_answered_by_the_coarsest(voxels: Callable[..., OccupancyVoxels]) -> None:
    v = voxels(1.0, levels=3, resolution=8)
    points = [[0.1, 0.1, 0.1], [0.9, 0.9, 0.9], [1.1, 0.1, 0.1]]
    assert v.admit(points, 50.0).tolist() == [True, False, True]


def test_far_places_are_told_apart_by_the_levels_that_reach_them(voxels: Callable[..., OccupancyVoxels]) -> None:
    v = voxels(0.05)
    far = [[1000.0, 0.0, 0.0], [1000.0, 0.0, 30.0], [1000.001, 0.0, 0.0]]
    assert v.admit(far, 0.0004).tolist() == [True, True, False]
    # Beyond the coarsest level's reach nothing can be told apart, and nothing is added.
    assert not v.admit([[1e9, 0.0, 0.0], [0.0, -1e30, 0.0]], 0.05).any()


def test_cells_lie_around_the_origin_that_was_settled(voxels: Callable[..., OccupancyVoxels]) -> None:
    v = voxels(1.0, levels=1, resolution=8)
    v.settle(2.0, (100.5, 0.0, 0.0))
    assert v.admit([[100.6, 0.1, 0.1], [102.4, 0.1, 0.1], [102.6, 0.1, 0.1]], 1.0).tolist() == [True, False, True]


def test_each_point_may_ask_for_its_own_size(voxels: Callable[..., OccupancyVoxels]) -> None:
    v = voxels(1.0, levels=3, resolution=8)
    v.update([[0.1, 0.1, 0.1]], 1.0)
    assert v.query([[0.2, 0.2, 0.2], [0.2, 0.2, 0.2]], [1.0, 0.25]).tolist() == [True, False]


def test_the_level_is_the_finest_with_cells_no_smaller_than_asked(voxels: Callable[..., OccupancyVoxels]) -> None:
    v = voxels(0.05, levels=8)
    assert v.level_of([1.0, 0.05, 0.0501, 0.025, 0.0251, 0.05 / 128, 1e-9, 0.0]).tolist() == [0, 0, 0, 1, 0, 7, 7, 7]


def test_cleared_voxels_are_as_good_as_fresh_ones(voxels: Callable[..., OccupancyVoxels]) -> None:
    rng = np.random.default_rng(3)
    v, plain = voxels(1.0, levels=6, resolution=64), PlainVoxels(0.7, 6)
    v.update(rng.uniform(-2, 2, (500, 3)), 0.05)
    v.clear()
    v.settle(0.7, (0.0, 0.0, 0.0))
    points = rng.uniform(-2, 2, (500, 3))
    assert not v.query(points, 5.0).any()
    assert v.admit(points, 0.1).tolist() == [plain.admit(p, 0.1) for p in points]


def test_marks_saved_in_one_form_are_restored_in_any_other(
    taichi_on_the_cpu: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    initialise("cpu")
    forms = []
    for form in FORMS:
        use(form, monkeypatch)
        forms.append(OccupancyVoxels(1.0, levels=9, resolution=64))
    rng = np.random.default_rng(4)
    # Some beyond the range of the finest stack of levels.
    points = rng.normal(size=(900, 3)) * 10 ** rng.uniform(-2, 4, (900, 1))
    sizes = 2.0 ** -rng.integers(0, 9, 900)
    marks = []
    for one in forms:
        one.update(points[:300], 2.0)
        one.clear()  # bricks stay and count on
        one.update(points, sizes)
        one.rest(points[::9])
        marks.append(one.marks())
        assert one.nbytes == forms[0].nbytes
    assert 0 < marks[0][2].mean() < 1  # some rest
    for saved in marks[1:]:
        for array, expected in zip(saved, marks[0], strict=True):
            np.testing.assert_array_equal(array, expected)
    for one, saved in zip(forms, marks[1:] + marks[:1], strict=True):
        one.update(points + 0.3, 0.01)
        one.restore(*saved)
        for array, expected in zip(one.marks(), saved, strict=True):
            np.testing.assert_array_equal(array, expected)


@pytest.mark.parametrize("levels", [3, 9, 15])
def test_places_that_rest_answer_as_before_and_take_less(voxels: Callable[..., OccupancyVoxels], levels: int) -> None:
    ours, plain = voxels(1.0, levels=levels, resolution=32), PlainVoxels(1.0, levels)
    rng = np.random.default_rng(5)
    for turn in range(6):
        points = rng.normal([40.0 * (turn % 3), 0.0, 0.0], size=(300, 3))  # three places, each of them twice
        sizes = 2.0 ** rng.uniform(-levels, 1, len(points))
        expected = [plain.occupied(p, size) for p, size in zip(points, sizes, strict=True)]
        assert ours.query(points, sizes).tolist() == expected
        expected = [plain.admit(p, size) for p, size in zip(points, sizes, strict=True)]
        assert ours.admit(points, sizes).tolist() == expected
        before = ours.nbytes
        ours.rest(points[:1])
        assert ours.nbytes < 0.5 * before
    assert ours._bricks.count < 300  # of one region
    ours.rest(np.zeros((0, 3)))
    assert ours._bricks.count == 0


def test_marking_adds_at_most_the_bytes_foretold_and_just_those_in_empty_voxels(
    voxels: Callable[..., OccupancyVoxels],
) -> None:
    ours = voxels(1.0, levels=6, resolution=64)
    rng = np.random.default_rng(3)
    for n, size in enumerate((0.05, 0.3, 2.0, 0.03, 0.05)):
        points = rng.uniform(-3, 3, (500, 3))
        points = points[~ours.query(points, size)]
        before, foretold = ours.nbytes, int(ours.bytes_to_mark(points, size).sum())
        ours.update(points, size)
        assert ours.nbytes <= before + foretold
        assert n > 0 or ours.nbytes == foretold > 0


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
def field(taichi_on_the_cpu: None, request: pytest.FixtureRequest) -> OccupancyVoxels:
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
def test_any_sequence_is_answered_as_by_sets(field: OccupancyVoxels, sequence) -> None:
    field.clear()
    marked: set[tuple[int, ...]] = set()
    for what, batch, size in sequence:
        xyz = np.array(batch)
        if what == "rest":
            field.rest(xyz)
        elif what == "update":
            field.update(xyz, size)
            marked |= set().union(*(cells_of(place, size) for place in batch))
        elif what == "query":
            assert field.query(xyz, size).tolist() == [cells_of(place, size) <= marked for place in batch]
        else:
            expected = []
            for place in batch:
                expected.append(not cells_of(place, size) <= marked)
                marked |= cells_of(place, size)
            assert field.admit(xyz, size).tolist() == expected

"""A region is refined as the whole map would be, by the views that see it, and only its own Gaussians come back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints
from pipelines.finished_map import FinishedMap
from pipelines.refinement import refine
from pipelines.regions.refinement import RefinedRegion, Span, refine_region, with_history
from pipelines.settings import RefineSettings
from tests.pipelines.mapped_wall import finished_map, finished_mapper, fresh_mapper

pytestmark = pytest.mark.slow

FRAMES, STEPS = 5, 6
REFINE = RefineSettings(steps=STEPS, views=2)


@pytest.fixture(scope="module")
def finished() -> FinishedMap:
    """A finished map of the wall, with the optimiser state of a new one."""
    kept = finished_map(finished_mapper(FRAMES))
    frames = [replace(view, points=SparsePoints()) for view in kept.frames]
    return replace(kept, gaussians=with_history(kept.gaussians), frames=frames)


def refined(finished: FinishedMap, own: NDArray[np.bool_], span: Span) -> RefinedRegion:
    return refine_region(fresh_mapper(), finished, own, REFINE, span)


@pytest.fixture(scope="module")
def whole(finished: FinishedMap) -> RefinedRegion:
    """The whole map as one region, in one round."""
    count = len(finished.gaussians["position"])
    return refined(finished, np.ones(count, dtype=bool), Span(0, STEPS, STEPS))


@pytest.fixture(scope="module")
def halves(finished: FinishedMap) -> list[RefinedRegion]:
    """The left and the right half as regions, after the first of two rounds."""
    left = finished.gaussians["position"][:, 0] < 0
    return [refined(finished, own, Span(0, STEPS // 2, STEPS)) for own in (left, ~left)]


def test_one_region_in_one_round_is_the_refinement_of_the_map(finished: FinishedMap, whole: RefinedRegion) -> None:
    mapper = fresh_mapper()
    values = {name: finished.gaussians[name] for name in mapper.gaussians.to_numpy()}
    mapper.go_on_with(replace(finished, gaussians=values))
    refine(mapper, REFINE)
    for name, array in mapper.gaussians.to_numpy().items():
        np.testing.assert_array_equal(array, whole.gaussians[name])
    assert not np.array_equal(whole.gaussians["sh"], values["sh"])
    assert set(whole.shares.values()) == {1.0}


def test_regions_return_their_own_gaussians_and_share_each_view(
    finished: FinishedMap, whole: RefinedRegion, halves: list[RefinedRegion]
) -> None:
    left, right = halves
    assert len(left.gaussians["position"]) + len(right.gaussians["position"]) == pytest.approx(
        len(whole.gaussians["position"]), abs=5
    )
    # None moves far in so few steps.
    assert left.gaussians["position"][:, 0].max() < 0.05
    assert right.gaussians["position"][:, 0].min() > -0.05
    # The camera moves to one side, and sees ever more of it.
    filled = [left.shares[index] for index in sorted(whole.shares)]
    assert sorted(filled) in (filled, filled[::-1])
    for index in whole.shares:
        assert left.shares[index] + right.shares[index] == pytest.approx(1.0, abs=1e-4)


def test_the_next_round_goes_on_with_steps_and_moments(finished: FinishedMap, halves: list[RefinedRegion]) -> None:
    assert max(half.gaussians["steps"].max() for half in halves) == STEPS // 2 * REFINE.views
    joined = {name: np.concatenate([half.gaussians[name] for half in halves]) for name in finished.gaussians}
    own = np.ones(len(joined["position"]), dtype=bool)
    second = refined(replace(finished, gaussians=joined), own, Span(STEPS // 2, STEPS, STEPS))
    assert second.gaussians["steps"].max() == STEPS * REFINE.views


def test_the_steps_of_all_rounds_are_one_decay() -> None:
    spans = [Span(0, 3, 7), Span(3, 7, 7)]
    shares = [span.schedule(step) for span in spans for step in range(span.first, span.end)]
    assert shares == [step / 6 for step in range(7)]
    assert [span.schedule(span.end) for span in spans] == [None, None]


def test_a_region_that_no_view_shows_stays_as_it_is(finished: FinishedMap) -> None:
    behind = {name: array[:4].copy() for name, array in finished.gaussians.items()}
    behind["position"] -= np.float32([0.0, 0.0, 100.0])
    both = {name: np.concatenate([array, behind[name]]) for name, array in finished.gaussians.items()}
    own = np.arange(len(both["position"])) >= len(finished.gaussians["position"])
    found = refined(replace(finished, gaussians=both), own, Span(0, STEPS, STEPS))
    for name in ("position", "sh", "steps"):
        np.testing.assert_array_equal(found.gaussians[name], behind[name])

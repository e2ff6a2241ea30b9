"""Views of a place apart leave the Gaussians of other places as they are."""

from __future__ import annotations

import numpy as np
import pytest

from fields.runtime.backend import initialise
from pipelines.online import OnlineMapper
from tests.pipelines.two_walls import APART, changed, shares, two_walls
from tests.pipelines.wall import frame


@pytest.fixture
def mapper(taichi_on_the_cpu: None) -> OnlineMapper:
    initialise("cpu")
    return two_walls()


def test_views_of_a_place_leave_the_gaussians_of_others(mapper: OnlineMapper) -> None:
    first, second, strangers, without_anchor = shares(mapper, [2, 3])
    assert first == strangers == 0.0
    assert min(second, without_anchor) > 0.5


def test_at_their_own_place_the_same_gaussians_are_optimised(mapper: OnlineMapper) -> None:
    first, second, *_ = shares(mapper, [0, 1])
    assert first > 0.5
    assert second == 0.0


def test_a_step_on_views_of_both_places_optimises_both(mapper: OnlineMapper) -> None:
    mapper.optimiser.settings = mapper.settings.model_copy(
        update={"optimise": mapper.settings.optimise.model_copy(update={"batch": 2})}
    )
    assert min(shares(mapper, [1, 2])) > 0.5


@pytest.mark.parametrize(("apart", "largest"), [(True, 0.8), (False, 2.0)])
def test_no_gaussian_reaches_from_one_place_to_the_next(mapper: OnlineMapper, apart: bool, largest: float) -> None:
    mapper.keyframes.begins = {2} if apart else set()
    depth, state, anchor = mapper.keyframes.scene_depth, mapper.gaussians.to_numpy(), mapper.gaussians.anchors()
    giants = np.arange(len(mapper.gaussians)) % 7 == 0
    state["log_scale"][giants, 1] = np.log(2.0 * depth)
    mapper.gaussians.load(state | {"anchor": anchor})
    seen = giants & changed(mapper, [2, 3])
    # Those that the views must not change otherwise are among them.
    assert (seen & (anchor == 0)).any()
    assert (seen & (anchor == 2)).any()
    sizes = np.exp(mapper.gaussians.to_numpy()["log_scale"].max(axis=1)) / depth
    assert sizes.max() == pytest.approx(largest, rel=0.1)


def test_back_at_a_place_later_views_optimise_what_the_first_ones_placed(mapper: OnlineMapper) -> None:
    mapper.process(frame(4))
    first = mapper.gaussians.anchors() == 0
    assert changed(mapper, [4])[first & (mapper.gaussians.to_numpy()["position"][:, 1] < APART[1] / 2)].mean() > 0.5

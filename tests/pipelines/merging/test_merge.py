"""Parts of the wall become one map."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.whole.merge import MappedPart, merge
from tests.pipelines.mapped_wall import finished_mapper, fresh_mapper
from tests.pipelines.wall import frame

FRAMES, CUT = 6, 3


@pytest.mark.slow
def test_of_two_parts_with_the_same_gaussians_each_stays_once() -> None:
    mapper = finished_mapper(FRAMES)
    store, gaussians = mapper.keyframes, mapper.gaussians.to_numpy()
    psnr = [mapper.optimiser.compare(view, store.scene_depth).psnr for view in store]
    parts = [
        MappedPart(
            own=own,
            gaussians=gaussians,
            keyframes=[view.index for view in store.selected],
            poses={index: store.corrected(index, T) for index, T in mapper.trajectory.items()},
            exposures={},
            scene_depth=store.scene_depth,
            view_renders=10,
        )
        for own in (range(CUT), range(CUT, FRAMES))
    ]
    mapper = fresh_mapper()
    kept = merge(mapper, parts, (frame(i) for i in range(FRAMES)))
    given, merged = (set(map(tuple, of["position"].tolist())) for of in (gaussians, mapper.gaussians.to_numpy()))
    assert len(mapper.gaussians) == len(merged) == sum(kept) and min(kept) > 0
    assert merged <= given and len(merged) > 0.9 * len(given)
    store = mapper.keyframes
    # Those that were left out show in no keyframe.
    assert np.min([mapper.optimiser.compare(view, store.scene_depth).psnr for view in store]) > min(psnr) - 0.5
    assert mapper.renderer.view_renders >= 20

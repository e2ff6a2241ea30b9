"""Parts of the wall become one map, which gets Gaussians where no part has left any."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.merging.merge import MappedPart, merge
from tests.pipelines.mapped_wall import finished_mapper, fresh_mapper
from tests.pipelines.wall import NORMAL, OFFSET, frame

pytestmark = pytest.mark.slow

FRAMES, CUT = 6, 3
# Radius of what no part has mapped of the wall, and how far around it the windows of SSIM show the error.
HOLE, AROUND = 0.7, 0.5


@pytest.fixture(scope="module")
def parts() -> list[MappedPart]:
    """Two parts with the same map of the wall, which has a hole in the middle of what the first frame shows."""
    mapper = finished_mapper(FRAMES)
    store, gaussians = mapper.keyframes, mapper.gaussians.to_numpy()
    whole = ~in_hole(gaussians)
    assert 20 < np.count_nonzero(~whole) < 0.5 * len(whole)
    poses = {index: store.corrected(index, T) for index, T in mapper.trajectory.items()}
    return [
        MappedPart(
            own=own,
            gaussians={name: array[whole] for name, array in gaussians.items()},
            keyframes=[view.index for view in store.selected],
            poses=poses,
            exposures={},
            scene_depth=store.scene_depth,
            view_renders=10,
        )
        for own in (range(CUT), range(CUT, FRAMES))
    ]


def in_hole(gaussians: Mapping[str, NDArray], radius: float = HOLE) -> NDArray[np.bool_]:
    centre = np.median(frame(0).points.xyz, axis=0)
    return np.linalg.norm(gaussians["position"][:, :2] - centre[:2], axis=1) < radius


def test_every_gaussian_comes_from_one_of_the_parts(parts: list[MappedPart]) -> None:
    mapper = fresh_mapper()
    kept = merge(mapper, parts, (frame(i) for i in range(FRAMES)))
    assert len(mapper.gaussians) == sum(kept) and min(kept) > 0
    given = {tuple(position) for position in parts[0].gaussians["position"].tolist()}
    assert all(tuple(position) in given for position in mapper.gaussians.to_numpy()["position"].tolist())
    assert mapper.renderer.view_renders >= sum(part.view_renders for part in parts)


def test_gaussians_are_added_where_the_merged_map_has_none(parts: list[MappedPart]) -> None:
    mapper = fresh_mapper()
    kept = merge(mapper, parts, (frame(i) for i in range(FRAMES)), fill=True)
    values, anchors = mapper.gaussians.to_numpy(), mapper.gaussians.anchors()
    added = slice(sum(kept), None)
    assert len(mapper.gaussians) > sum(kept)
    near_hole = in_hole({"position": values["position"][added]}, HOLE + AROUND).mean()
    assert near_hole > 0.8 > 2.0 * in_hole(parts[0].gaussians, HOLE + AROUND).mean()
    # Each moves with the keyframe that has placed it, and lies on the wall that this one sees.
    for place in np.unique(anchors[added]).tolist():
        view = mapper.keyframes[place]
        mine = values["position"][added][anchors[added] == place].astype(np.float64)
        local = mine @ view.T_camera_world[:3, :3].T + view.T_camera_world[:3, 3]
        assert view.camera.contains(view.camera.project(local)).all()
    np.testing.assert_allclose(values["position"][added] @ NORMAL, OFFSET, atol=0.02)

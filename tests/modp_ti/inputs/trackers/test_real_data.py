"""Real sequences: the delivered points project onto their pixels under the delivered poses and cameras.

Skipped where the data is not there. Oracles: the COLMAP models' own reprojection error, and the agreement of
two independent reconstructions of the same photographs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from modp_ti.inputs.readers.colmap import ColmapSettings
from modp_ti.inputs.readers.transforms import TransformsSettings
from modp_ti.inputs.replay import PosedImage, ReplayedTracker
from modp_ti.inputs.source_settings import SourceSettings
from tests.opening import opened_with

pytestmark = pytest.mark.real_data


def reprojection_errors(frame: PosedImage) -> NDArray[np.float64]:
    """In pixels of the stored image."""
    T, camera = frame.T_camera_world, frame.undistorter.camera
    p = frame.points.xyz @ T[:3, :3].T + T[:3, 3]
    scale = frame.undistorter.raw.width / camera.width
    return scale * np.linalg.norm(camera.project(p) - frame.points.pixels, axis=1)


def centres(tracker: ReplayedTracker) -> NDArray[np.float64]:
    return np.array([-f.T_camera_world[:3, :3].T @ f.T_camera_world[:3, 3] for f in tracker.frames])


@pytest.mark.parametrize(
    ("name", "frames", "size", "least_points"),
    [("desk", 29, (476, 268), 500), ("fox", 50, (270, 480), 700), ("redkitchen", 200, (160, 120), 50)],
)
def test_colmap_points_project_onto_their_pixels(shared_data, name, frames, size, least_points):
    data = shared_data(name)
    tracker = opened_with(SourceSettings(path=data / "images", scale=0.25), ColmapSettings())
    assert len(tracker) == frames
    for frame in tracker.frames:
        assert np.median(reprojection_errors(frame)) < 2.0
        assert len(frame.points) >= least_points
    first = next(iter(tracker))
    assert (first.camera.width, first.camera.height) == size
    assert first.image.std() > 0.1


@pytest.fixture(scope="module")
def fox_transforms() -> ReplayedTracker:
    data = Path(__file__).resolve().parents[5] / "shared" / "data" / "fox"
    if not data.is_dir():
        pytest.skip("no ../shared/data/fox")
    source = SourceSettings(path=data / "images", scale=0.25, holdout=8)
    return opened_with(source, TransformsSettings())


def test_fox_is_triangulated_densely_and_exactly(fox_transforms):
    errors = [reprojection_errors(frame) for frame in fox_transforms.frames]
    assert min(len(each) for each in errors) >= 300
    assert np.median(np.concatenate(errors)) < 1.5
    assert max(np.median(each) for each in errors) < 2.0


def test_fox_poses_and_depths_of_both_files_agree(shared_data, fox_transforms):
    data = shared_data("fox")
    colmap = opened_with(SourceSettings(path=data / "images", scale=0.25), ColmapSettings())
    assert [f.name for f in colmap.frames] == [f.name for f in fox_transforms.frames]

    # The worlds differ by a similarity: relative rotations do not depend on it.
    R_a, R_b = (np.array([f.T_camera_world[:3, :3] for f in t.frames]) for t in (fox_transforms, colmap))
    relative = [np.einsum("fij,fkj->fik", R[1:], R[:-1]) for R in (R_a, R_b)]
    turn = Rotation.from_matrix(np.einsum("fij,fkj->fik", *relative)).magnitude()
    assert np.degrees(turn).max() < 0.5

    a, b = centres(fox_transforms), centres(colmap)
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    scale = np.sqrt((a**2).sum() / (b**2).sum())
    world = Rotation.align_vectors(a, scale * b)[0]
    off = np.linalg.norm(a - scale * world.apply(b), axis=1)
    assert np.median(off) < 0.01 * np.linalg.norm(a, axis=1).mean()

    ratios = []
    for ours, theirs in zip(fox_transforms.frames, colmap.frames, strict=True):
        between = np.linalg.norm(ours.points.pixels[:, None] - theirs.points.pixels[None], axis=2)
        same = between.argmin(axis=1)
        close = between.min(axis=1) < 0.5
        depth = [f.points.xyz @ f.T_camera_world[2, :3] + f.T_camera_world[2, 3] for f in (ours, theirs)]
        ratios.append(depth[0][close] / (scale * depth[1][same[close]]))
    deviation = np.abs(np.concatenate(ratios) - 1)
    assert len(deviation) > 10_000
    assert np.median(deviation) < 0.01
    assert np.percentile(deviation, 98) < 0.1

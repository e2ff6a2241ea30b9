"""What captures of every kind have in common beside the contract of readers: depth maps, adjustment, refusals."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from modp_ti.files.errors import InputError
from modp_ti.inputs.inspection.conventions import STATED
from modp_ti.inputs.inspection.geometry import judge_geometry, measure_geometry
from modp_ti.inputs.inspection.survey import survey
from modp_ti.inputs.replay import ReplayedTracker
from tests.samples.captures import WRITERS
from tests.samples.filmed import OPENGL

WITH_DEPTH = ("record3d", "scanner_app", "stray_scanner", "polycam", "scannet", "arkitscenes")


@pytest.mark.parametrize("kind", WITH_DEPTH)
def test_points_are_those_of_the_depth_maps_that_the_sensor_trusts(kind, views, tmp_path, opened):
    if kind == "record3d":
        pytest.importorskip("lzfse")
    WRITERS[kind](tmp_path / kind, views)
    tracker = opened(tmp_path / kind, kind, max_depth=20)
    ids = np.concatenate([frame.points.ids for frame in tracker.frames])
    assert len(np.unique(ids)) == len(ids) >= 200 * len(views)
    for frame in tracker.frames:  # across the image, but for the strip that the sensor does not trust
        assert np.abs(frame.points.xyz[:, 2]).max() < 2e-3
        x, y = frame.points.pixels.T
        assert np.histogram2d(x, y, bins=4, range=[[40, 300], [0, 240]])[0].min() >= 3


def test_without_depth_maps_points_are_triangulated(views, tmp_path, opened):
    WRITERS["kitti"](tmp_path / "room", views[:4])
    for frame in opened(tmp_path / "room", "kitti").frames:
        assert len(frame.points) > 50
        assert np.median(np.abs(frame.points.xyz[:, 2])) < 0.02


@pytest.mark.parametrize("kind", ["scanner_app", "euroc"])
def test_a_wrong_axes_convention_is_found_by_check(kind, views, tmp_path, untriangulated, opened):
    """The images show it: points of depth maps fit the poses whatever these are."""
    WRITERS[kind](tmp_path / kind, [view.posed(view.T_world_camera @ OPENGL) for view in views[:4]])
    geometry = measure_geometry(survey(opened(tmp_path / kind, kind), 4, lambda _: None))
    assert next(finding.code for finding in judge_geometry(geometry)) == "opengl_axes"


def test_damaged_depth_maps_are_left_out_up_to_a_few(views, tmp_path, opened):
    WRITERS["scanner_app"](tmp_path / "app", views[:3])
    (tmp_path / "app" / "depth_00003.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"depth_00003.png"):
        opened(tmp_path / "app", "scanner_app")
    tracker = opened(tmp_path / "app", "scanner_app", depth=False)
    assert all(len(frame.points) > 50 for frame in tracker.frames)


def test_depths_that_are_far_or_at_edges_are_not_used(views, tmp_path, opened):
    WRITERS["scannet"](tmp_path / "scene", views[:2])
    for n in range(2):
        file = str(tmp_path / f"scene/depth/{n}.png")
        depth = np.array(cv2.imread(file, cv2.IMREAD_UNCHANGED))
        depth[10:20, 10:20] = 2000  # before the plane, with an edge around it
        cv2.imwrite(file, depth)
    frames = opened(tmp_path / "scene", "scannet", max_points=2000).frames
    depths = np.concatenate([frame.points.depths(frame.T_camera_world) for frame in frames])
    block = np.abs(depths - 2.0) < 1e-4
    assert (depths[~block] > 3.5).all()
    assert 2 * 30 < block.sum() <= 2 * 64  # without the outermost pixels of the block
    near = opened(tmp_path / "scene", "scannet", max_points=2000, max_depth=3.0).frames
    assert np.concatenate([frame.points.depths(frame.T_camera_world) for frame in near]).max() == pytest.approx(2.0)


def test_poses_are_adjusted_where_it_is_asked_for(views, tmp_path, opened):
    moved = []
    for view, offset in zip(views, np.random.default_rng(2).normal(0, 0.02, (4, 3)), strict=False):
        T = view.T_world_camera.copy()
        T[:3, 3] += offset
        moved.append(view.posed(T))
    WRITERS["scanner_app"](tmp_path / "app", moved)
    tracker = opened(tmp_path / "app", "scanner_app", adjust=True)
    assert any("bundle adjusted" in note for note in tracker.notes)
    assert _epipolar_error(tracker) < 0.5 * _epipolar_error(opened(tmp_path / "app", "scanner_app"))


def _epipolar_error(tracker: ReplayedTracker) -> float:
    return measure_geometry(survey(tracker, 4, lambda _: None)).epipolar[STATED].error


def test_a_tracker_of_another_kind_is_refused(views, tmp_path, opened):
    WRITERS["polycam"](tmp_path / "polycam", views[:2])
    for place, kind, source, said in (
        ("polycam", "record3d", {}, "is no capture of kind record3d"),
        ("polycam", "polycam", {"kind": "images"}, "source.kind: images"),
        ("gone", "polycam", {}, "no such capture"),
    ):
        with pytest.raises(InputError, match=said):
            opened(tmp_path / place, kind, source)

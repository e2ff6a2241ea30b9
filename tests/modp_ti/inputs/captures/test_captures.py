"""Captures of every kind deliver the poses, cameras and points that they were made with."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from modp_ti.commands import app as cli
from modp_ti.config.settings import SourceSettings
from modp_ti.files.errors import InputError
from modp_ti.inputs import posed_recording
from modp_ti.inputs.bare_recording import recorded_scene
from modp_ti.inputs.inspection.conventions import STATED
from modp_ti.inputs.inspection.geometry import judge_geometry, measure_geometry
from modp_ti.inputs.inspection.survey import survey
from modp_ti.inputs.opening import open_source, open_tracker, recognised_kind
from modp_ti.inputs.replay import ReplayedTracker
from tests.captures import OPENGL, WRITERS, View, zipped
from tests.opening import CAPTURES

WITH_DEPTH = ("record3d", "scanner_app", "stray_scanner", "polycam", "scannet", "arkitscenes")
ARCHIVED = ("record3d", "polycam", "nerfcapture")


def needs_lzfse(kind: str) -> None:
    if kind == "record3d":
        pytest.importorskip("lzfse")


def assert_delivers(tracker: ReplayedTracker, views: list[View], least_points: int) -> None:
    assert len(tracker.frames) == len(views)
    for frame, view in zip(tracker.frames, views, strict=True):
        np.testing.assert_allclose(frame.T_camera_world, np.linalg.inv(view.T_world_camera), atol=1e-6)
        np.testing.assert_allclose(frame.undistorter.raw.matrix(), view.K, atol=1e-6)
        points = frame.points
        assert len(points) >= least_points
        in_camera = points.xyz @ frame.T_camera_world[:3, :3].T + frame.T_camera_world[:3, 3]
        np.testing.assert_allclose(frame.undistorter.camera.project(in_camera), points.pixels, atol=1e-3)
        assert np.abs(points.xyz[:, 2]).max() < 2e-3  # on the plane: depths are rounded to a millimetre


@pytest.mark.parametrize("kind", WITH_DEPTH)
def test_poses_cameras_and_points_of_the_depth_maps_are_the_true_ones(kind, views, tmp_path, opened):
    needs_lzfse(kind)
    WRITERS[kind](tmp_path / kind, views)
    tracker = opened(tmp_path / kind, kind, max_depth=20)
    assert_delivers(tracker, views, 200)
    ids = np.concatenate([frame.points.ids for frame in tracker.frames])
    assert len(np.unique(ids)) == len(ids)
    for frame in tracker.frames:  # across the image, but for the strip that the sensor does not trust
        x, y = frame.points.pixels.T
        assert np.histogram2d(x, y, bins=4, range=[[40, 300], [0, 240]])[0].min() >= 3
    again = opened(tmp_path / kind, kind, max_depth=20)
    for a, b in zip(tracker.frames, again.frames, strict=True):
        np.testing.assert_array_equal(a.points.xyz, b.points.xyz)


@pytest.mark.parametrize("kind", [kind for kind in WRITERS if kind not in WITH_DEPTH])
def test_without_depth_maps_points_are_triangulated(kind, views, tmp_path, opened):
    WRITERS[kind](tmp_path / kind, views[:4])
    tracker = opened(tmp_path / kind, kind)
    assert len(tracker.frames) == 4
    for frame, view in zip(tracker.frames, views, strict=False):
        np.testing.assert_allclose(frame.T_camera_world, np.linalg.inv(view.T_world_camera), atol=1e-6)
        np.testing.assert_allclose(frame.undistorter.raw.matrix(), view.K, atol=1e-6)
        assert len(frame.points) > 50
        assert np.median(np.abs(frame.points.xyz[:, 2])) < 0.02


@pytest.mark.parametrize("kind", WRITERS)
def test_images_are_those_of_their_poses_and_in_order_of_time(kind, views, tmp_path, opened):
    needs_lzfse(kind)
    WRITERS[kind](tmp_path / kind, views)
    tracker = opened(tmp_path / kind, kind, {"step": 3, "scale": 0.5, "holdout": 2}, **_untriangulated(kind))
    frames = list(tracker)
    assert [frame.held_out for frame in frames] == [True, False, True]
    assert (np.diff([frame.timestamp for frame in frames]) > 0).all()
    for frame, view in zip(frames, views[::3], strict=True):
        assert frame.camera.width == 160
        small = cv2.resize(view.image, (160, 120), interpolation=cv2.INTER_AREA)[..., ::-1] / 255.0
        assert np.abs(frame.image - small).mean() < 0.03  # the video is packed with loss


def _untriangulated(kind: str) -> dict[str, object]:
    return {"max_points": 40} if kind in WITH_DEPTH else {}


@pytest.mark.parametrize("kind", ARCHIVED)
@pytest.mark.parametrize("top", ["", "capture"])
def test_an_archive_is_the_same_as_its_folder(kind, top, views, tmp_path, opened):
    needs_lzfse(kind)
    WRITERS[kind](tmp_path / "folder", views[:3])
    file = zipped(tmp_path / "folder", tmp_path / f"room.{'r3d' if kind == 'record3d' else 'zip'}", top)
    config = recorded_scene(file)
    assert config.tracker.kind == kind
    assert config.output.name == "room"
    packed, unpacked = open_tracker(config), opened(tmp_path / "folder", kind)
    assert isinstance(packed, ReplayedTracker)
    for a, b in zip(packed, unpacked, strict=True):
        assert a.name == b.name
        np.testing.assert_array_equal(a.T_camera_world, b.T_camera_world)
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(a.points.xyz, b.points.xyz)


@pytest.mark.parametrize("kind", WRITERS)
def test_a_folder_alone_is_recognised_and_tracked_by_its_own_poses(kind, views, tmp_path):
    WRITERS[kind](tmp_path / kind, views[:2])
    assert recognised_kind(tmp_path / kind) == kind
    assert recorded_scene(tmp_path / kind).tracker.kind == kind
    assert recorded_scene(tmp_path / kind, ["tracker.kind=klt"]).tracker.kind == "klt"


def test_every_kind_is_written_by_a_test():
    assert set(WRITERS) == set(CAPTURES)


@pytest.mark.parametrize("kind", WRITERS)
def test_a_wrong_axes_convention_is_found_by_check(kind, views, tmp_path, monkeypatch, opened):
    """The images tell it: points of depth maps fit the poses whatever these are. Triangulation would take seconds."""
    monkeypatch.setattr(posed_recording, "triangulated_frames", lambda _, frames, *__: frames)
    needs_lzfse(kind)
    flipped = [replace(view, T_world_camera=view.T_world_camera @ OPENGL) for view in views[:4]]
    WRITERS[kind](tmp_path / kind, flipped)
    geometry = measure_geometry(survey(opened(tmp_path / kind, kind), 4, lambda _: None))
    assert next(finding.code for finding in judge_geometry(geometry)) == "opengl_axes"


def test_check_accepts_a_capture_alone(views, tmp_path):
    WRITERS["scanner_app"](tmp_path / "app", views[:3])
    (tmp_path / "scene.yaml").write_text("source: {path: app}\ntracker: {kind: scanner_app}\noutput: out\n")
    result = CliRunner().invoke(cli.app, ["check", str(tmp_path / "scene.yaml"), "--quiet"])
    assert result.exit_code < 2, result.output


def test_damaged_depth_maps_are_left_out_up_to_a_few(views, tmp_path, opened):
    WRITERS["scanner_app"](tmp_path / "app", views[:3])
    (tmp_path / "app" / "depth_00003.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"depth_00003.png: unreadable depth map.*tracker.depth: false"):
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
    rng = np.random.default_rng(2)
    moved = []
    for view in views[:4]:
        T = view.T_world_camera.copy()
        T[:3, 3] += rng.normal(0, 0.02, 3)
        moved.append(replace(view, T_world_camera=T))
    WRITERS["scanner_app"](tmp_path / "app", moved)
    tracker = opened(tmp_path / "app", "scanner_app", adjust=True)
    assert any("bundle adjusted" in note for note in tracker.notes)
    assert _epipolar_error(tracker) < 0.5 * _epipolar_error(opened(tmp_path / "app", "scanner_app"))


def _epipolar_error(tracker: ReplayedTracker) -> float:
    return measure_geometry(survey(tracker, 4, lambda _: None)).epipolar[STATED].error


def test_another_tracker_gets_the_images_and_the_first_camera(views, tmp_path):
    WRITERS["polycam"](tmp_path / "polycam", views[:3])
    images = open_source(SourceSettings(path=tmp_path / "polycam"))
    assert images.intrinsics is not None
    np.testing.assert_allclose(images.intrinsics.camera.matrix(), views[0].K)
    assert len(images) == 3


def test_a_tracker_of_another_kind_is_refused(views, tmp_path, opened):
    WRITERS["polycam"](tmp_path / "polycam", views[:2])
    with pytest.raises(InputError, match=r"is no capture of kind record3d, which holds metadata and rgbd"):
        opened(tmp_path / "polycam", "record3d")
    with pytest.raises(InputError, match=r"source.kind: images has no poses of tracker.kind: polycam"):
        opened(tmp_path / "polycam", "polycam", {"kind": "images"})
    with pytest.raises(InputError, match=r"gone: no such capture"):
        opened(tmp_path / "gone", "polycam")

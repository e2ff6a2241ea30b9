"""`KltTracker` over files: what it delivers, corrects, says and refuses."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.files.errors import InputError
from modp_ti.inputs.delivered_frames import settled
from modp_ti.inputs.klt import KltTracker, open_klt
from modp_ti.inputs.klt.opening import estimated_intrinsics
from modp_ti.inputs.readers.klt import KltSettings
from modp_ti.inputs.source_settings import IntrinsicsSettings, SourceSettings
from modp_ti.inputs.sources import FrameReader, ImageFolder, Intrinsics
from modp_ti.outputs.evaluation import absolute_trajectory_error
from tests.modp_ti.inputs.klt.conftest import Walk, turning_walk

pytestmark = pytest.mark.slow


def known_camera(folder: Path, box_room, **settings) -> KltTracker:
    source, images = SourceSettings(path=folder, **settings), ImageFolder(folder)
    images.scale = settings.get("scale", 1.0)
    intrinsics = Intrinsics(box_room.camera)
    return KltTracker(FrameReader(images, source), intrinsics)


def off_pixels(frame: TrackedFrame) -> np.ndarray:
    """Distances (N,) [px] of a frame's points from where it sees them."""
    p = frame.points.xyz @ frame.T_camera_world[:3, :3].T + frame.T_camera_world[:3, 3]
    return np.linalg.norm(frame.camera.project(p) - frame.points.pixels, axis=1)


def test_frames_keep_the_contract_of_a_tracker_and_corrections_lead_to_the_last_poses(box_room, box_walk, tmp_path):
    folder = box_walk.written(tmp_path / "images")
    tracker = known_camera(folder, box_room, scale=0.5, holdout=8)
    frames, poses, corrections = [], {}, 0
    for event in tracker:
        if isinstance(event, PoseCorrection):
            corrections += 1
            assert set(event.index.tolist()) <= set(poses), "a frame is corrected after it was delivered"
            poses.update(zip(event.index.tolist(), event.T_camera_world, strict=True))
        else:
            frames.append(event)
            poses[event.index] = event.T_camera_world
    assert corrections >= 1 and tracker.frame_count == len(frames)
    assert [frame.index for frame in frames] == list(range(60))
    assert [frame.name for frame in frames] == [f"{i:04d}.png" for i in range(60)]
    assert [frame.index for frame in frames if frame.held_out] == list(range(0, 60, 8))
    np.testing.assert_allclose([frame.timestamp for frame in frames], np.arange(60) / 30)
    assert absolute_trajectory_error([poses[i] for i in range(60)], box_walk.poses) < 0.01
    camera = box_room.camera.resized(160, 120)
    for frame in frames:
        assert frame.camera == camera and frame.image.shape == (120, 160, 3)
        error = off_pixels(frame)
        assert len(error) > 60 and np.median(error) < 0.3 and error.max() < 1.5
    # A point's number keeps its meaning: it shows the same place of the room in two frames.
    a, b = frames[20].points, frames[28].points
    shared, at_a, at_b = np.intersect1d(a.ids, b.ids, return_indices=True)
    places = []
    for points, at, T in ((a, at_a, box_walk.poses[20]), (b, at_b, box_walk.poses[28])):
        local = camera.unproject(points.pixels[at], box_room.depth(T, 2 * points.pixels[at]))
        places.append((local - T[:3, 3]) @ T[:3, :3])
    assert len(shared) > 30 and np.median(np.linalg.norm(places[0] - places[1], axis=1)) < 0.02
    # Another pass, whose corrections are applied to the frames: the same images, and points where they are seen.
    for frame in settled(known_camera(folder, box_room, scale=0.5, holdout=8)):
        np.testing.assert_array_equal(frame.T_camera_world, poses[frame.index])
        np.testing.assert_array_equal(frame.image, frames[frame.index].image)
        np.testing.assert_array_equal(frame.points.ids, frames[frame.index].points.ids)
        assert np.median(off_pixels(frame)) < 0.3


def test_frames_without_a_pose_are_not_counted_and_masked_points_not_delivered(box_room, box_walk, tmp_path):
    folder, masks = box_walk.written(tmp_path / "images"), tmp_path / "masks"
    masks.mkdir()
    mask = np.full((240, 320), 255, np.uint8)
    mask[:, 200:] = 0
    for i in range(45):
        cv2.imwrite(str(masks / f"{i:04d}.png"), mask)
    for i in range(35, 38):
        cv2.imwrite(str(folder / f"{i:04d}.png"), np.zeros((240, 320, 3), np.uint8))
    tracker = known_camera(folder, box_room, stop=45, masks=masks)
    assert tracker.frame_count == 45
    expected = []
    for frame in tracker:
        if isinstance(frame, TrackedFrame):
            expected.append(tracker.frame_count)
            assert len(frame.points) > 30 and (frame.points.pixels[:, 0] < 200).all()
    assert expected[:30] == [45] * 30
    assert len(expected) == tracker.frame_count == expected[-1] < 45


def test_a_camera_that_nobody_described_is_estimated_and_enough_keyframes_end_that(box_room, box_walk, tmp_path):
    tracker = open_klt(SourceSettings(path=box_walk.written(tmp_path / "images")))
    assert "estimated" in tracker.notes[0]
    assert tracker.intrinsics.camera.fx == pytest.approx(box_room.camera.fx, rel=0.1)  # 2 to 4.1 % over two draws
    images = [(grey, None) for grey in box_walk.grey]
    found, used = estimated_intrinsics(images, (320, 240), 0.9 * box_room.camera.fx, 0, None, 60, enough=10)
    assert found is not None and 10 <= used < 60


def test_images_that_do_not_tell_the_camera_give_a_guess_and_a_map_of_nothing_is_refused(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for i in range(4):
        cv2.imwrite(str(folder / f"{i}.png"), np.zeros((120, 160, 3), np.uint8))
    tracker = open_klt(SourceSettings(path=folder))
    assert "is a guess" in tracker.notes[0]
    with pytest.raises(InputError, match="could place none of the 4 images"):
        list(tracker)


def test_images_of_two_sizes_are_refused_before_tracking(tmp_path):
    for i, width in enumerate((160, 160, 100)):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.zeros((120, width, 3), np.uint8))
    with pytest.raises(InputError, match=r"2\.png is 100x120, the first image 160x120"):
        open_klt(SourceSettings(path=tmp_path))


def test_desk_is_tracked_from_its_images_alone(shared_data):
    """Oracle: COLMAP's poses of the same images."""
    import pycolmap

    data = shared_data("desk")
    frames = list(settled(open_klt(SourceSettings(path=data / "images", scale=0.25))))
    model = pycolmap.Reconstruction(str(data / "sparse" / "0"))
    truth = {image.name: np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in model.images.values()}
    assert len(frames) >= 27
    poses = [truth[frame.name] for frame in frames]
    error = absolute_trajectory_error([frame.T_camera_world for frame in frames], poses)
    centres = np.array([-T[:3, :3].T @ T[:3, 3] for T in poses])
    assert error < 0.01 * np.linalg.norm(np.diff(centres, axis=0), axis=1).sum()


def test_frames_of_a_guessed_camera_are_delivered_at_once_and_corrected_when_it_is_found(box_room, box_walk, tmp_path):
    folder = box_walk.written(tmp_path / "images")
    source, images = SourceSettings(path=folder, scale=0.5), ImageFolder(folder)
    images.scale = 0.5
    guess = Intrinsics(replace(box_room.camera, fx=1.12 * box_room.camera.fx, fy=1.12 * box_room.camera.fy))
    tracker = KltTracker(FrameReader(images, source), guess, is_guess=True)
    events = list(tracker)
    revisions = [n for n, event in enumerate(events) if isinstance(event, PoseCorrection) and event.camera is not None]
    first = revisions[0]
    assert isinstance(events[0], TrackedFrame) and events[0].camera.fx == pytest.approx(guess.camera.fx / 2)
    assert 10 <= first < 60, "frames are delivered before the camera is found"
    found = tracker.intrinsics.camera.fx
    assert abs(found / box_room.camera.fx - 1) < 0.5 * 0.12
    assert events[revisions[-1]].camera.camera.fx == pytest.approx(found / 2)
    frames = [event for event in events if isinstance(event, TrackedFrame)]
    assert len(frames) == 60 and frames[-1].camera.fx == pytest.approx(found / 2)
    assert "estimated from" in tracker.notes[-1]
    for one in settled(KltTracker(FrameReader(images, source), guess, is_guess=True)):
        assert one.camera == frames[-1].camera and np.median(off_pixels(one)) < 0.4


def test_frames_of_a_second_map_come_with_their_own_images_when_it_is_joined(box_room, box_walk, tmp_path):
    there = [box_room.image(T) for T in turning_walk(60)]
    black = np.zeros((240, 320, 3), np.uint8)
    images = [*box_walk.images[:30], *[black] * 12, *there]
    folder = Walk([], images).written(tmp_path / "images")
    tracker = known_camera(folder, box_room)
    frames = list(settled(tracker))
    assert [int(frame.name[:4]) for frame in frames] == [*range(30), *range(42, 102)]
    assert tracker.frame_count == 90
    for frame in frames[::10]:
        np.testing.assert_allclose(frame.image, images[int(frame.name[:4])] / 255, atol=1e-3)
    truth = [*box_walk.poses[:30], *turning_walk(60)]
    assert absolute_trajectory_error([frame.T_camera_world for frame in frames], truth) < 0.02
    assert any("1 maps begun anew were joined" in note for note in tracker.notes)


def test_loops_without_gtsam_are_refused_in_one_line(box_walk, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    source = SourceSettings(path=box_walk.written(tmp_path / "images"))
    with pytest.raises(InputError) as error:
        open_klt(source, KltSettings(loops=True))
    assert str(error.value).endswith("pip install 'modp-ti[loops]'") and "\n" not in str(error.value)


@pytest.fixture(scope="module")
def two_places(box_room, box_walk, tmp_path_factory) -> SourceSettings:
    """A recording of a place, of nothing, and for longer of another."""
    black = [np.zeros((240, 320, 3), np.uint8)] * 12
    walk = Walk([], [*(box_room.mirrored().image(T) for T in box_walk.poses[:45]), *black, *box_walk.images])
    camera = box_room.camera
    intrinsics = IntrinsicsSettings(fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy)
    folder = walk.written(tmp_path_factory.mktemp("places") / "images")
    return SourceSettings(path=folder, intrinsics=intrinsics, scale=0.25)


def test_the_frames_of_the_wanted_map_are_delivered_and_the_others_told(two_places):
    told = []
    tracker = open_klt(two_places, KltSettings(maps="all"), progress=lambda what, *_: told.append(what))
    assert tracker.frame_count == 60 and set(told) == {"tracking"}
    frames = [event for event in tracker if isinstance(event, TrackedFrame)]
    assert [frame.name for frame in frames] == [f"{number:04d}.png" for number in range(57, 117)]
    assert [frame.index for frame in frames] == list(range(60))
    assert all(len(frame.points) > 60 for frame in frames)
    assert tracker.further_maps == 1
    (note,) = (note for note in tracker.notes if "other maps" in note)
    assert "0000.png to 0044.png" in note and "1 of them are mapped" in note
    with pytest.raises(InputError, match=r"tracker\.maps: 3: klt made 2 maps"):
        open_klt(two_places, KltSettings(maps=3))

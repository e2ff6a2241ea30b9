"""Every kind that reads poses, given the same small recording, delivers the same frames, and says what does not fit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from fields.frames.origin import far_origin, shifted
from modp_ti.config.bare_recording import recorded_scene
from modp_ti.config.keys import variants_of
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_source, open_tracker, recognised_kind
from modp_ti.inputs.readers import READERS
from tests.opening import CAPTURES, assert_poses, off_pixels, opened
from tests.samples.captures import WRITERS, zipped
from tests.samples.kinds import FRAMES, SAMPLES, SIZE, SMALL, write_sample

KINDS = [kind for kind, sample in SAMPLES.items() if sample.is_tracker]
# Kinds whose files hold neither points nor depths, so that so small pictures give none.
WITHOUT_POINTS = ("nerfcapture", "euroc", "kitti")
# Kinds whose points are those of a depth sensor.
APPS = ("record3d", "scanner_app", "polycam", "stray_scanner")
WITH_DEPTHS = (*APPS, "replica_depth", "arkitscenes", "scannet", "bag_depth")
# Their files hold coordinates as float32, which are lost far from the origin.
NEAR_ALONE = ("transforms", "ply", "modp", *(kind for kind in KINDS if kind.startswith("bag_")))
BY_NAMES = ("colmap_text", "colmap", "transforms", "modp")
TEXTS = ("tum", "orbslam3", "matrices", "tanksandtemples", "replica", "sevenscenes", "modp", "colmap_text", "euroc")
FAR = 452_000.0


def written(kind: str, folder: Path, filmed=SMALL) -> Path:
    if kind == "record3d":
        pytest.importorskip("lzfse")
    write_sample(kind, folder, filmed)
    return folder


def every(kinds) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("kind", list(kinds))


def assert_frames(frames) -> None:
    """The frames have the poses of the views, and points on the plane and on their pixels."""
    frames = list(frames)
    assert_poses(frames, SMALL.views)
    for frame in frames:
        if len(frame.points):
            assert (frame.points.depths(frame.T_camera_world) > 0).all() and off_pixels(frame).max() < 0.1
            assert np.median(np.abs(frame.points.xyz[:, 2])) < 2e-3  # depths are rounded to a millimetre


@every(KINDS)
def test_poses_cameras_points_and_images_are_those_that_were_filmed(kind: str, tmp_path: Path) -> None:
    tracker = opened(written(kind, tmp_path / "a"))
    frames = list(tracker)
    assert_frames(frames)
    assert (np.diff([frame.timestamp for frame in frames]) > 0).all()
    assert {frame.depth_deviation is not None for frame in frames} == {kind in WITH_DEPTHS}
    for frame, posed, view in zip(frames, tracker.frames, SMALL.views, strict=True):
        np.testing.assert_allclose(posed.undistorter.raw.matrix(), view.K, atol=1e-6)
        expected = view.image[..., 1] / 255.0  # green: bags are grey
        assert np.abs(frame.image[..., 1] - expected).mean() < 0.05  # JPEG and videos are packed with loss
        assert len(frame.points) >= (0 if kind in WITHOUT_POINTS else 15)
        assert len(np.unique(frame.points.ids)) == len(frame.points)
    for frame, same in zip(frames, opened(tmp_path / "a"), strict=True):
        np.testing.assert_array_equal(frame.points.xyz, same.points.xyz)


@every(KINDS)
def test_held_out_images_change_no_other_frame(kind: str, tmp_path: Path) -> None:
    folder = written(kind, tmp_path / "a")
    first = opened(folder, "source.holdout=2")
    before = list(first)
    assert [frame.held_out for frame in before] == [True, False, True]
    image = next(iter(folder.rglob(first.frames[0].name)), None)
    if image is None:
        return  # a bag, an archive or a video
    cv2.imwrite(str(image), np.random.default_rng(1).integers(0, 255, (*SIZE[::-1], 3), np.uint8))
    for frame, same in zip(before[1::2], list(opened(folder, "source.holdout=2"))[1::2], strict=True):
        np.testing.assert_array_equal(frame.image, same.image)
        np.testing.assert_array_equal(frame.T_camera_world, same.T_camera_world)
        np.testing.assert_array_equal(frame.points.xyz, same.points.xyz)


@every(kind for kind in KINDS if kind not in NEAR_ALONE)
def test_far_from_the_origin_the_frames_are_the_same_near_it(kind: str, tmp_path: Path) -> None:
    near = list(opened(written(kind, tmp_path / "near")))
    far = list(opened(written(kind, tmp_path / "far", SMALL.moved((FAR, 0.0, 0.0)))))
    origin = far_origin(far[0].T_camera_world, far[0].points)
    assert np.linalg.norm(origin) == pytest.approx(FAR, rel=1e-3)
    for a, b in zip(near, (shifted(frame, -origin) for frame in far), strict=True):
        moved = b.T_camera_world[:3, 3] - a.T_camera_world[:3, 3]
        assert np.abs(moved).max() < 200.0, "float32 has digits left for a hundredth of a pixel"
        np.testing.assert_allclose(b.points.depths(b.T_camera_world), a.points.depths(a.T_camera_world), atol=1e-5)


@every(KINDS)
def test_what_is_missing_is_one_line_that_names_it(kind: str, tmp_path: Path) -> None:
    for number, name in enumerate(SAMPLES[kind].files):
        folder = written(kind, tmp_path / str(number))
        (folder / name).unlink()
        try:
            notes = opened(folder).notes
        except InputError as error:
            assert "\n" not in str(error) and str(tmp_path) in str(error)
        else:
            assert notes, f"{name} is missing and nothing is said"


@every(KINDS)
def test_frames_without_a_pose_and_poses_without_an_image_are_counted(kind: str, tmp_path: Path) -> None:
    folder = written(kind, tmp_path / "a")
    expected = opened(folder)
    image = next(iter(folder.rglob(expected.frames[1].name)), None)
    if image is None:
        return  # a bag, an archive or a video
    image.unlink()
    found = opened(folder)
    if kind in ("matrices", "tanksandtemples", "tum", "ply", "orbslam3", "kitti", "stella_vslam", "aria"):
        assert len(found.frames) == FRAMES - 1, "which images have which pose is by their places and times"
        return
    assert [frame.name for frame in found.frames] == [expected.frames[i].name for i in (0, 2)]
    np.testing.assert_allclose(found.frames[1].T_camera_world, expected.frames[2].T_camera_world)


@every(BY_NAMES)
@pytest.mark.parametrize("other", [str.upper, lambda name: name.replace(".png", ".jpg")], ids=["case", "suffix"])
def test_names_in_another_writing_are_found_with_a_note(kind: str, other: Callable[[str], str], tmp_path: Path) -> None:
    folder = written(kind, tmp_path / "a")
    for name in SMALL.names:
        file = next(folder.rglob(name))
        if other(name).endswith(".jpg"):
            cv2.imwrite(str(file.with_name(other(name))), np.asarray(cv2.imread(str(file))))
            file.unlink()
        else:
            file.rename(file.with_name(other(name)))
    found = opened(folder)
    assert any(other(name) in note for name in SMALL.names for note in found.notes)
    assert_frames(found)


@every(TEXTS)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_text_has_any_byte_order_mark(kind: str, encoding: str, tmp_path: Path) -> None:
    folder = written(kind, tmp_path / "a")
    for file in folder.rglob("*"):
        if file.suffix in (".txt", ".log", ".json", ".yaml", ".csv"):
            file.write_text(file.read_text(), encoding=encoding)
    assert_frames(opened(folder))


@every(CAPTURES)
def test_a_capture_alone_is_recognised_and_tracked_by_its_own_poses(kind: str, tmp_path: Path) -> None:
    """It may lie in the only folder of a folder."""
    WRITERS[kind](tmp_path / "42/42_frames", SMALL.views)
    for folder in (tmp_path / "42/42_frames", tmp_path / "42"):
        assert recognised_kind(folder) == kind
        assert recorded_scene(folder).tracker.kind == kind
    assert recorded_scene(tmp_path / "42", ["tracker.kind=klt"]).tracker.kind == "klt"
    images = open_source(recorded_scene(tmp_path / "42").source)
    assert images.intrinsics is not None and len(images) == FRAMES
    np.testing.assert_allclose(images.intrinsics.camera.matrix(), SMALL.K, atol=1e-6)


@every(["polycam", "nerfcapture", "scanner_app"])
@pytest.mark.parametrize("top", ["", "capture"])
def test_an_archive_is_the_same_as_its_folder(kind: str, top: str, tmp_path: Path) -> None:
    """What macOS adds to archives is left out."""
    WRITERS[kind](tmp_path / "folder", SMALL.views)
    (tmp_path / "folder/__MACOSX").mkdir()
    (tmp_path / "folder/__MACOSX/._1700000.json").write_text("x")
    config = recorded_scene(zipped(tmp_path / "folder", tmp_path / "room.zip", top))
    assert (config.tracker.kind, config.output.name) == (kind, "room")
    packed, unpacked = open_tracker(config), open_tracker(recorded_scene(tmp_path / "folder"))
    for a, b in zip(packed, unpacked, strict=True):
        assert a.name == b.name
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(a.points.xyz, b.points.xyz)


@every(variants_of(SceneConfig.model_fields["tracker"]))
def test_every_kind_of_a_scene_is_opened_and_names_what_is_missing(kind: str, tmp_path: Path) -> None:
    source = {} if kind == "socket" else {"path": tmp_path / "gone"}
    tracker = {"kind": kind, **({"path": tmp_path / "gone" / "socket"} if kind == "socket" else {})}
    config = SceneConfig.model_validate({"source": source, "tracker": tracker, "output": tmp_path / "out"})
    with pytest.raises(InputError) as caught:
        open_tracker(config)
    assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)


def test_there_is_a_sample_of_every_kind_that_reads_files() -> None:
    assert set(READERS) - {"klt", "sfm", "socket", "bag"} <= set(SAMPLES), "bags have a sample for each form"
    assert set(CAPTURES) == set(WRITERS)

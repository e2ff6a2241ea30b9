"""Every kind that reads poses, given the same small recording, delivers the same frames, and says what does not fit."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from fields.frames.origin import far_origin, shifted
from fields.geometry.se3 import camera_centres
from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.replay import ReplayedTracker
from tests.fault_injection import samples, small_bag, small_recording, tracker_samples
from tests.fault_injection.samples import CAPTURES, SAMPLES, write_sample
from tests.fault_injection.small_recording import FRAMES, NAMES

TRACKERS = ("colmap_text", "colmap", "transforms", "tum", "ply", "orbslam3", "tum_rgbd", "replica", "matrices")
TRACKERS += ("tanksandtemples", "sevenscenes", "modp", "aria", "stella_vslam", "video")
KINDS = (*TRACKERS, *CAPTURES, *(name for name in SAMPLES if name.startswith("bag_")))
# Their files hold coordinates as float32, which are lost far from the origin, or times that a change of place changes.
NEAR_ALONE = ("transforms", "ply", "modp", "stray_scanner")
BY_NAMES = ("colmap_text", "colmap", "transforms", "modp")
FAR = 452_000.0


def opened(folder: Path, *overrides: str) -> ReplayedTracker:
    tracker = open_tracker(load_scene(folder / "scene.yaml", list(overrides)))
    assert isinstance(tracker, ReplayedTracker)
    return tracker


def written(kind: str, folder: Path) -> Path:
    if kind == "record3d":
        pytest.importorskip("liblzfse")
    write_sample(kind, folder)
    return folder


@pytest.mark.parametrize("kind", KINDS)
def test_poses_are_world_to_camera_and_points_lie_on_their_pixels(kind: str, tmp_path: Path) -> None:
    frames = list(opened(written(kind, tmp_path / "a")))
    assert len(frames) == FRAMES
    centres = camera_centres([frame.T_camera_world for frame in frames])
    np.testing.assert_allclose(centres - centres[0], [[0.1 * i, 0, 0] for i in range(FRAMES)], atol=1e-5)
    for frame in frames:
        p = frame.points.xyz @ frame.T_camera_world[:3, :3].T + frame.T_camera_world[:3, 3]
        if len(p):  # without depth maps or a map, so small pictures give none
            assert (p[:, 2] > 0).all()
            assert np.linalg.norm(frame.camera.project(p) - frame.points.pixels, axis=1).max() < 0.6


@pytest.mark.parametrize("kind", KINDS)
def test_held_out_images_change_no_other_frame(kind: str, tmp_path: Path) -> None:
    folder = written(kind, tmp_path / "a")
    first = opened(folder, "source.holdout=2")
    before = list(first)
    assert [frame.held_out for frame in before] == [True, False, True]
    image = next(iter(folder.rglob(first.frames[0].name)), None)
    if image is None:
        return  # a bag, an archive or a video
    cv2.imwrite(str(image), np.random.default_rng(1).integers(0, 255, (*before[0].image.shape,), np.uint8))
    for frame, same in zip(before[1::2], list(opened(folder, "source.holdout=2"))[1::2], strict=True):
        np.testing.assert_array_equal(frame.image, same.image)
        np.testing.assert_array_equal(frame.T_camera_world, same.T_camera_world)
        np.testing.assert_array_equal(frame.points.xyz, same.points.xyz)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in NEAR_ALONE and not kind.startswith("bag_")])
def test_far_from_the_origin_the_frames_are_the_same_near_it(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    near = list(opened(written(kind, tmp_path / "near")))
    place, wall = small_recording.position, small_recording.wall()
    for module in (samples, small_bag, small_recording, tracker_samples):
        monkeypatch.setattr(module, "position", lambda i: FAR + place(i))
        monkeypatch.setattr(module, "wall", lambda: wall + np.array([FAR, 0.0, 0.0]))
    far = list(opened(written(kind, tmp_path / "far")))
    origin = far_origin(far[0].T_camera_world, far[0].points)
    assert np.linalg.norm(origin) == pytest.approx(FAR, rel=1e-3)
    for a, b in zip(near, (shifted(frame, -origin) for frame in far), strict=True):
        moved = b.T_camera_world[:3, 3] - a.T_camera_world[:3, 3]
        assert np.abs(moved).max() < 200.0, "float32 has digits left for a hundredth of a pixel"
        np.testing.assert_allclose(
            b.points.depths(b.T_camera_world), a.points.depths(a.T_camera_world), atol=1e-5, err_msg=kind
        )


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_missing_is_one_line_that_names_it(kind: str, tmp_path: Path) -> None:
    sample = SAMPLES[kind][0]
    for number, name in enumerate(sample.files):
        folder = written(kind, tmp_path / str(number))
        (folder / name).unlink()
        try:
            notes = opened(folder).notes
        except InputError as error:
            assert "\n" not in str(error) and str(tmp_path) in str(error)
        else:
            assert notes, f"{name} is missing and nothing is said"


@pytest.mark.parametrize("kind", BY_NAMES)
@pytest.mark.parametrize("other", [str.upper, lambda name: name.replace(".png", ".jpg")], ids=["case", "suffix"])
def test_names_in_another_writing_are_found_with_a_note(kind: str, other, tmp_path: Path) -> None:
    folder = written(kind, tmp_path / "a")
    expected = opened(folder)
    for name in NAMES:
        file = next(folder.rglob(name))
        if other(name).endswith(".jpg"):
            cv2.imwrite(str(file.with_name(other(name))), cv2.imread(str(file)))
            file.unlink()
        else:
            file.rename(file.with_name(other(name)))
    found = opened(folder)
    assert len(found.frames) == len(expected.frames)
    assert any(other(name) in note for name in NAMES for note in found.notes)
    for a, b in zip(expected.frames, found.frames, strict=True):
        np.testing.assert_array_equal(a.T_camera_world, b.T_camera_world)


@pytest.mark.parametrize("kind", ("tum", "orbslam3", "matrices", "tanksandtemples", "replica", "sevenscenes", "modp"))
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_text_has_any_byte_order_mark(kind: str, encoding: str, tmp_path: Path) -> None:
    folder = written(kind, tmp_path / "a")
    expected = list(opened(folder))
    for file in folder.rglob("*"):
        if file.suffix in (".txt", ".log", ".json", ".yaml"):
            file.write_text(file.read_text(), encoding=encoding)
    for a, b in zip(expected, opened(folder), strict=True):
        np.testing.assert_array_equal(a.T_camera_world, b.T_camera_world)
        np.testing.assert_array_equal(a.points.xyz, b.points.xyz)

"""Bare pictures of the test room: their poses are found, kept, and found anew when something has changed."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from fields.geometry.se3 import camera_centres, exp_se3, inverse_se3
from modp_ti.files.errors import InputError
from modp_ti.inputs.readers import sfm
from modp_ti.inputs.readers.sfm import SfmSettings
from modp_ti.inputs.source_settings import IntrinsicsSettings, SourceSettings
from modp_ti.outputs.evaluation import umeyama
from tests.opening import opened_with
from tests.panoramas import equirectangular_rays, panorama, stroll
from tests.room import Room, RoomRecording, pinhole, walk

CAMERA = pinhole(240, 180)
POSES = walk(6, step=0.25)


@pytest.fixture
def source(room: Room, tmp_path: Path) -> SourceSettings:
    """Six pictures in no order of the alphabet, one of which has a blank in its name."""
    (tmp_path / "images").mkdir()
    for i, image in enumerate(RoomRecording(room, CAMERA, POSES).images):
        cv2.imwrite(str(tmp_path / "images" / f"view {i + 7}.png"), image[..., ::-1])
    return SourceSettings(path=tmp_path / "images", scale=0.5, intrinsics=IntrinsicsSettings(fx=CAMERA.fx))


def test_the_frames_have_the_poses_and_points_of_the_room(source: SourceSettings, room: Room, tmp_path: Path) -> None:
    said: list[str] = []
    frames = list(opened_with(source, SfmSettings(), lambda what, done, total: said.append(what), tmp_path))
    assert [frame.name for frame in frames] == [f"view {i + 7}.png" for i in range(6)]
    assert list(dict.fromkeys(said)) == ["finding features", "matching images", "placing the images"]
    s, R, t = umeyama(camera_centres([frame.T_camera_world for frame in frames]), camera_centres(POSES))
    for frame, T in zip(frames, POSES, strict=True):
        assert frame.camera.fx == pytest.approx(0.5 * CAMERA.fx)
        centre = camera_centres([frame.T_camera_world])[0]
        assert np.linalg.norm(s * R @ centre + t - camera_centres([T])[0]) < 0.03
        assert len(frame.points) > 20
        # The points lie on the surfaces of the room.
        depth = room.depth(frame.camera, T, frame.points.pixels)
        assert np.median(np.abs(s * frame.points.depths(frame.T_camera_world) / depth - 1)) < 0.1


def test_the_faces_of_panoramas_are_placed_as_a_rig(room: Room, tmp_path: Path) -> None:
    """The third panorama is black, and its faces are left out."""
    (tmp_path / "images").mkdir()
    poses, rays = stroll(7, step=0.15), equirectangular_rays(256)
    for i, T in enumerate(poses):
        image = panorama(room, T, rays) * (i != 2)
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), image[..., ::-1])
    settings = {"path": tmp_path / "images", "panorama": {"projection": "equirectangular", "faces": 4}, "holdout": 3}
    source = SourceSettings.model_validate(settings)
    opened = opened_with(source, SfmSettings(), output=tmp_path)
    frames, placed = list(opened), [T for i, T in enumerate(poses) if i != 2]
    assert [int(frame.name[0]) for frame in frames[::4]] == [0, 1, 3, 4, 5, 6]
    assert any("1 of 7 images have no pose" in note for note in opened.notes)
    s, R, t = umeyama(camera_centres([frame.T_camera_world for frame in frames[::4]]), camera_centres(placed))
    for group, T in zip((frames[i : i + 4] for i in range(0, len(frames), 4)), placed, strict=True):
        assert len({frame.held_out for frame in group}) == 1
        for number, frame in enumerate(group):
            found, turn = frame.T_camera_world, exp_se3([0, 0, 0, 0, -np.pi / 2 * number, 0])
            np.testing.assert_allclose(found @ inverse_se3(group[0].T_camera_world), turn, atol=1e-6)
            np.testing.assert_allclose(s * R @ camera_centres([found])[0] + t, camera_centres([T])[0], atol=0.02)
            turned = (found @ inverse_se3(frames[0].T_camera_world), turn @ T @ inverse_se3(placed[0]))
            np.testing.assert_allclose(turned[0][:3, :3], turned[1][:3, :3], atol=0.01)
            p = frame.points.xyz @ found[:3, :3].T + found[:3, 3]
            off = np.linalg.norm(frame.camera.project(p) - frame.points.pixels, axis=1)
            assert len(off) > 20 and np.median(off) < 0.7
    again = SourceSettings.model_validate({**settings, "panorama": {**settings["panorama"], "fov": 95}})
    assert not any("used again" in note for note in opened_with(again, SfmSettings(), output=tmp_path).notes)


def test_the_model_is_kept_until_images_or_settings_change(
    source: SourceSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []
    monkeypatch.setattr(sfm, "_reconstruct", lambda *arguments, _made=sfm._reconstruct: made.append(_made(*arguments)))
    first = opened_with(source, SfmSettings(), output=tmp_path)
    again = opened_with(source, SfmSettings(), output=tmp_path)
    assert len(made) == 1 and any("used again" in note for note in again.notes)
    np.testing.assert_array_equal(first.frames[3].T_camera_world, again.frames[3].T_camera_world)
    opened_with(source, SfmSettings(features=1500), output=tmp_path)
    assert len(made) == 2
    assert source.path is not None
    shutil.copyfile(source.path / "view 8.png", source.path / "view 9.png")
    opened_with(source, SfmSettings(features=1500), output=tmp_path)
    assert len(made) == 3


def test_pictures_without_a_scene_are_wrong_input(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    for i in range(4):
        noise = np.random.default_rng(i).integers(0, 256, (60, 80, 3), dtype=np.uint8)
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), noise)
    with pytest.raises(InputError, match="could not join three of the 4 images"):
        opened_with(SourceSettings(path=tmp_path / "images", scale=1), SfmSettings(), output=tmp_path)
    assert not (tmp_path / "sfm").exists()

"""Panoramas of a box room that are tracked as a rig of faces."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.se3 import inverse_se3
from modp_ti.config.settings import SourceSettings
from modp_ti.files.errors import InputError
from modp_ti.inputs.klt import KltTracker, open_klt
from tests.modp_ti.inputs.klt.conftest import BoxRoom
from tests.panoramas import equirectangular_rays, fisheye_rays, stroll

COUNT, FACES = 24, 4
RAYS = {"equirectangular": equirectangular_rays(256), "dual_fisheye": fisheye_rays(256, 200.0)}


def written(folder: Path, room: BoxRoom, poses: list[NDArray[np.float64]], rays: NDArray[np.float64]) -> Path:
    for i, T in enumerate(poses):
        image = room.colours(inverse_se3(T)[:3, 3], np.nan_to_num(rays, nan=1.0) @ T[:3, :3])
        image[np.isnan(rays).any(axis=-1)] = 0
        cv2.imwrite(str(folder / f"{i:04d}.png"), image[..., ::-1])
    return folder


def opened(folder: Path, projection: str = "equirectangular", **keys: object) -> KltTracker:
    panorama = {"projection": projection, "faces": FACES, "fov": 100, "lens_fov": 200}
    return open_klt(SourceSettings.model_validate({"path": folder, "panorama": panorama, **keys}))


def error(frames: list[TrackedFrame], poses: list[NDArray[np.float64]]) -> float:
    """Root mean square error of the first faces' centres after alignment, as a share of the path."""
    first = [frame for frame in frames if frame.index % FACES == 0]
    true = np.array([inverse_se3(poses[int(frame.name[:4])])[:3, 3] for frame in first])
    found = np.array([inverse_se3(frame.T_camera_world)[:3, 3] for frame in first])
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, scale, vt = np.linalg.svd(b.T @ a)
    mirror = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    aligned = (scale * np.diag(mirror)).sum() / (a**2).sum() * a @ (u @ mirror @ vt).T
    path = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    return float(np.sqrt(((aligned - b) ** 2).sum(axis=1).mean()) / path)


@pytest.fixture(scope="module")
def poses() -> list[NDArray[np.float64]]:
    return stroll(COUNT)


@pytest.fixture(scope="module")
def panoramas(box_room: BoxRoom, poses: list[NDArray[np.float64]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("panoramas"), box_room, poses, RAYS["equirectangular"])


@pytest.fixture(scope="module")
def frames(panoramas: Path) -> list[TrackedFrame]:
    tracker = opened(panoramas, holdout=5)
    delivered = [event for event in tracker.events() if isinstance(event, TrackedFrame)]
    assert [frame.index for frame in delivered] == list(range(FACES * COUNT))
    return list(tracker)


def test_a_walk_is_found_again(frames: list[TrackedFrame], poses: list[NDArray[np.float64]]) -> None:
    assert error(frames, poses) < 0.005
    turns = [frame.T_camera_world[:3, :3] for frame in frames[::FACES]]
    for i in range(COUNT):
        found, true = turns[i] @ turns[0].T, poses[i][:3, :3] @ poses[0][:3, :3].T
        assert np.degrees(np.arccos(np.clip((np.trace(found @ true.T) - 1) / 2, -1, 1))) < 0.5


def test_the_faces_of_a_panorama_have_one_time_one_centre_and_one_rig(frames: list[TrackedFrame]) -> None:
    for i in range(0, len(frames), FACES):
        group = frames[i : i + FACES]
        assert len({frame.timestamp for frame in group}) == 1
        assert {frame.views for frame in group} == {FACES}
        assert len({frame.held_out for frame in group}) == 1
        assert group[0].held_out == (i // FACES % 5 == 0)
        for number, frame in enumerate(group):
            T = frame.T_camera_world @ inverse_se3(group[0].T_camera_world)
            np.testing.assert_allclose(T[:3, 3], 0.0, atol=1e-6)
            turned = np.pi / 2 * number
            np.testing.assert_allclose(T[2, :3], [np.sin(turned), 0.0, np.cos(turned)], atol=1e-6)


def test_every_face_sees_points_where_they_are(frames: list[TrackedFrame]) -> None:
    for frame in frames:
        assert len(frame.points) > 50
        p = frame.points.xyz @ frame.T_camera_world[:3, :3].T + frame.T_camera_world[:3, 3]
        off = np.linalg.norm(frame.camera.project(p) - frame.points.pixels, axis=1)
        assert np.median(off) < 0.7
    seen = [set(frame.points.ids.tolist()) for frame in frames]
    assert not seen[0] & seen[1], "a landmark is seen in one face of a time"


def test_a_rig_that_was_lost_is_found_again(
    box_room: BoxRoom, poses: list[NDArray[np.float64]], tmp_path: Path
) -> None:
    written(tmp_path, box_room, poses, RAYS["equirectangular"])
    for i in (12, 13):
        cv2.imwrite(str(tmp_path / f"{i:04d}.png"), np.zeros((256, 512, 3), np.uint8))
    frames = list(opened(tmp_path))
    placed = {int(frame.name[:4]) for frame in frames}
    assert placed == set(range(COUNT)) - {12, 13}
    assert error(frames, poses) < 0.01


def test_two_fisheye_lenses_are_a_rig_too(box_room: BoxRoom, poses: list[NDArray[np.float64]], tmp_path: Path) -> None:
    frames = list(opened(written(tmp_path, box_room, poses[:14], RAYS["dual_fisheye"]), "dual_fisheye"))
    assert len(frames) == 14 * FACES
    assert error(frames, poses) < 0.01


def test_start_stop_and_step_count_panoramas(panoramas: Path) -> None:
    tracker = opened(panoramas, start=2, stop=20, step=2)
    assert tracker.frame_count == 9 * FACES
    assert [frame.name[:4] for frame in tracker][::FACES] == [f"{i:04d}" for i in range(2, 20, 2)]


def test_panoramas_without_texture_are_told(tmp_path: Path) -> None:
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((64, 128, 3), 90, np.uint8))
    with pytest.raises(InputError, match=r"klt could place none of the 12 images"):
        list(opened(tmp_path))

"""Corners followed along a video lie where geometry says, and nothing of a held-out frame reaches another."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.multiview import triangulation
from modp_ti.inputs.multiview.followed_features import follow_features
from modp_ti.inputs.replay import PosedImage
from modp_ti.inputs.sources import Distortion, ImageFolder, Undistorter

FRAMES = 16
HELD_OUT = np.arange(FRAMES) % 4 == 0
SIZE = (240, 180)
CAMERA = PinholeCamera(220.0, 220.0, 120.5, 89.0, *SIZE)
METRES = 0.01  # of a texel of the plane z = 0


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A camera that passes a textured plane, three away, and turns meanwhile. Folder and T_camera_world (F, 4, 4)."""
    rng = np.random.default_rng(11)
    texture = np.zeros((600, 800), np.float32)
    for size in (4, 8, 16, 40):
        noise = rng.random((600 // size + 2, 800 // size + 2)).astype(np.float32)
        texture += cv2.resize(noise, (800, 600), interpolation=cv2.INTER_CUBIC)
    texture = np.clip(255 * (texture - texture.min()) / np.ptp(texture), 0, 255).astype(np.uint8)
    world_texture = np.array([[METRES, 0, -4.0], [0, METRES, -3.0], [0, 0, 1]])
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])  # to cv2's integer centres
    folder = tmp_path_factory.mktemp("video")
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    for i, T in enumerate(poses):
        T[:3, :3] = Rotation.from_euler("yxz", [1.5 * i - 12, 0.4 * i, 0.5 * i], degrees=True).as_matrix()
        T[:3, 3] = T[:3, :3] @ [0.05 * i - 0.4, 0.0, 3.0]
        H = half @ CAMERA.matrix() @ T[:3, [0, 1, 3]] @ world_texture @ np.linalg.inv(half)
        cv2.imwrite(str(folder / f"{i:03d}.png"), cv2.warpPerspective(texture, H, SIZE, flags=cv2.INTER_AREA))
    return folder, poses


def posed(video, camera: Undistorter | None = None) -> tuple[ImageFolder, list[PosedImage]]:
    images = ImageFolder(video[0])
    undistorter = camera or Undistorter(CAMERA)
    return images, [PosedImage(name, undistorter, T) for name, T in zip(images.names, video[1], strict=True)]


def test_points_lie_on_the_plane_and_keep_their_numbers(video, monkeypatch):
    monkeypatch.setattr(triangulation, "FEW_FRAMES", 5)
    images, frames = posed(video)
    result = triangulation.triangulated_frames(images, frames, np.ones(FRAMES, bool))
    for frame in result:
        assert len(frame.points) >= 100
        z = frame.points.xyz[:, 2]
        assert np.median(np.abs(z)) < 0.02 and np.percentile(np.abs(z), 90) < 0.1  # three away
        p = frame.points.xyz @ frame.T_camera_world[:3, :3].T + frame.T_camera_world[:3, 3]
        error = np.linalg.norm(CAMERA.project(p) - frame.points.pixels, axis=1)
        assert np.median(error) < 0.5
    shared = set(result[4].points.ids.tolist()) & set(result[9].points.ids.tolist())
    assert len(shared) >= 30


def test_a_lens_is_followed_through_too(video, tmp_path, monkeypatch):
    """The same views through a lens, made by cv2's own undistortion maps turned around."""
    lens = Distortion((-0.15, 0.03))
    columns, rows = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    K = CAMERA.matrix()
    ideal = cv2.undistortPoints(
        np.stack([columns, rows], -1).reshape(-1, 1, 2), K, np.array([-0.15, 0.03, 0, 0]), P=K
    ).reshape(SIZE[1], SIZE[0], 2)
    for file in sorted(video[0].iterdir()):
        image = np.array(Image.open(file))
        maps = (ideal - 0.5).astype(np.float32)
        bent = cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        cv2.imwrite(str(tmp_path / file.name), bent)
    monkeypatch.setattr(triangulation, "FEW_FRAMES", 5)
    images, frames = posed((tmp_path, video[1]), Undistorter(CAMERA, lens))
    result = triangulation.triangulated_frames(images, frames, np.ones(FRAMES, bool))
    z = np.concatenate([frame.points.xyz[:, 2] for frame in result])
    assert len(z) > 1500 and np.median(np.abs(z)) < 0.03


def off(video) -> np.ndarray:
    """The poses, each turned by half a degree and shifted by two pixels or so."""
    rng = np.random.default_rng(2)
    wrong = video[1].copy()
    for T in wrong:
        T[:3, :3] = Rotation.from_rotvec(np.radians(0.3) * rng.standard_normal(3)).as_matrix() @ T[:3, :3]
        T[:3, 3] += 0.01 * rng.standard_normal(3)
    return wrong


def next_turns(poses: np.ndarray) -> Rotation:
    return Rotation.from_matrix((poses[1:] @ np.linalg.inv(poses[:-1]))[:, :3, :3])


@pytest.mark.slow
@pytest.mark.parametrize("few", [5, 60], ids=["followed", "matched"])
def test_adjusted_poses_are_those_of_the_images(video, monkeypatch, few):
    monkeypatch.setattr(triangulation, "FEW_FRAMES", few)
    wrong = off(video)
    images, frames = posed((video[0], wrong))
    result, note = triangulation.adjusted_frames(images, frames, ~HELD_OUT)
    before, after = (float(word) for word in re.findall(r"([\d.]+) px", note))
    assert after < 0.5 < before
    found = np.stack([frame.T_camera_world for frame in result])
    truth = next_turns(video[1])
    before, after = (np.degrees((truth.inv() * next_turns(poses)).magnitude()) for poses in (wrong, found))
    assert np.median(before) > 0.4
    assert np.median(after) < 0.08 and after.max() < 0.25, "held-out frames too"
    for i, frame in enumerate(result):
        assert len(frame.points) >= (80 if HELD_OUT[i] else 100)
        p = frame.points.xyz @ frame.T_camera_world[:3, :3].T + frame.T_camera_world[:3, 3]
        assert np.median(np.linalg.norm(CAMERA.project(p) - frame.points.pixels, axis=1)) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize(("few", "adjusts"), [(5, False), (60, True)])
def test_held_out_frames_change_nothing_but_their_own(video, tmp_path, monkeypatch, few, adjusts):
    """Whatever they show, the points and the poses of the others are the same bit for bit."""
    monkeypatch.setattr(triangulation, "FEW_FRAMES", few)
    for i, file in enumerate(sorted(video[0].iterdir())):
        image = np.array(Image.open(file))
        cv2.imwrite(str(tmp_path / file.name), 255 - image[::-1] if HELD_OUT[i] else image)
    poses, results = off(video) if adjusts else video[1], []
    for folder in (video[0], tmp_path):
        images, frames = posed((folder, poses))
        if adjusts:
            results.append(triangulation.adjusted_frames(images, frames, ~HELD_OUT)[0])
        else:
            results.append(triangulation.triangulated_frames(images, frames, ~HELD_OUT))
    for held_out, before, after in zip(HELD_OUT, *results, strict=True):
        if held_out:
            assert len(before.points) >= 80 and len(after.points) < 20, "a negative shows none of the corners"
            continue
        assert np.array_equal(before.T_camera_world, after.T_camera_world)
        for each in ("xyz", "pixels", "ids"):
            assert np.array_equal(getattr(before.points, each), getattr(after.points, each))


def test_frames_too_far_apart_to_be_followed_are_matched(video, monkeypatch):
    monkeypatch.setattr(triangulation, "FEW_FRAMES", 5)
    images, frames = posed(video)
    for frame in triangulation.triangulated_frames(images, frames[0::5] + frames[3::5], np.ones(7, bool)):
        assert len(frame.points) >= 50 and np.median(np.abs(frame.points.xyz[:, 2])) < 0.02


def test_frames_without_any_corner_have_none(tmp_path, video):
    for i in range(4):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((SIZE[1], SIZE[0], 3), 128, np.uint8))
    images, frames = posed((tmp_path, video[1][:4]))
    for solves in (np.ones(4, bool), np.zeros(4, bool)):
        assert len(follow_features(images, frames, solves)) == 0

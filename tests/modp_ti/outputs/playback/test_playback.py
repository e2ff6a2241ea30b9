"""Camera paths, films, and the frames of a finished run."""

from __future__ import annotations

import shutil
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3
from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_tracker
from modp_ti.outputs.formats.dataset import write_image
from modp_ti.outputs.playback.camera_paths import looking_at, orbit, smoothed
from modp_ti.outputs.playback.film import VIDEO_SUFFIXES, write_video
from modp_ti.outputs.playback.finished_run import open_run
from modp_ti.outputs.playback.run_frames import FinishedFrames, frames_of, pictures

UP = np.array([0.0, 0.0, 1.0])


def ring(angles: NDArray, inwards: bool, radius: float = 2.0, centre: tuple = (1.0, -2.0, 0.5)) -> NDArray:
    """Upright cameras on a circle, 0.4 above its centre, that look across it or away from it."""
    poses = []
    for angle in angles:
        way = np.array([np.cos(angle), np.sin(angle), 0.0])
        eye = np.array(centre) + radius * way + [0, 0, 0.4]
        poses.append(looking_at(eye, np.array(centre) if inwards else eye + way, UP))
    return np.stack(poses)


def centres(poses: NDArray) -> NDArray:
    return -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])


def assert_rigid(poses: NDArray) -> None:
    R = poses[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-9)
    assert (np.linalg.det(R) > 0).all()


def test_looking_at_puts_the_target_in_the_middle_and_up_upwards() -> None:
    T = looking_at(np.array([1.0, 2.0, 3.0]), np.array([-1.0, 0.5, 2.0]), UP)
    p = T[:3, :3] @ [-1.0, 0.5, 2.0] + T[:3, 3]
    np.testing.assert_allclose(p[:2], 0, atol=1e-12)
    assert p[2] > 0
    assert (T[:3, :3] @ UP)[1] < 0  # y of the camera points down


def test_a_ring_around_an_object_is_closed_into_a_whole_turn_that_looks_at_it() -> None:
    poses = orbit(ring(np.linspace(0, 2 * np.pi, 30, endpoint=False), inwards=True), depth=2.0, count=40)
    assert_rigid(poses)
    away = centres(poses) - [1.0, -2.0, 0.5]
    np.testing.assert_allclose(np.linalg.norm(away[:, :2], axis=1), 2.0, rtol=1e-2)
    angles = np.unwrap(np.arctan2(away[:, 1], away[:, 0]))
    np.testing.assert_allclose(np.abs(np.diff(angles)), 2 * np.pi / 40, rtol=1e-2)
    assert (np.einsum("ij,ij->i", poses[:, 2, :3], -away) > 0).all()


def test_within_a_room_it_looks_outwards_as_the_cameras_do() -> None:
    keyframes = ring(np.linspace(0, 2 * np.pi, 30, endpoint=False), inwards=False, radius=0.5)
    poses = orbit(keyframes, depth=3.0, count=24)
    away = centres(poses) - np.array([1.0, -2.0, 0.9])
    assert (np.einsum("ij,ij->i", poses[:, 2, :3], away) > 0).all()


def test_what_was_seen_from_one_side_is_not_gone_around() -> None:
    taken = np.radians(np.linspace(150, 240, 30))  # across the cut of the angle at 180 degrees
    poses = orbit(ring(taken, inwards=True), depth=2.0, count=60)
    away = centres(poses) - [1.0, -2.0, 0.5]
    angles = np.degrees(np.arctan2(away[:, 1], away[:, 0])) % 360
    assert 150 < angles.min() < 170 and 220 < angles.max() < 240
    assert np.abs(np.diff(angles, append=angles[:1])).max() < 6  # to and fro, without a jump at its end


def test_one_keyframe_is_enough_for_an_orbit() -> None:
    poses = orbit(ring(np.zeros(1), inwards=True), depth=2.0, count=8)
    assert_rigid(poses)
    assert np.isfinite(poses).all()


def test_smoothing_keeps_a_steady_motion_and_calms_a_trembling_one() -> None:
    step = exp_se3([0.02, 0.0, 0.01, 0.0, 0.01, 0.0])
    steady = [np.eye(4)]
    for _ in range(59):
        steady.append(step @ steady[-1])
    rng = np.random.default_rng(1)
    trembling = np.stack([exp_se3(rng.normal(0, 0.01, 6)) @ T for T in steady])
    steady = np.stack(steady)
    assert_rigid(smoothed(trembling, 100, 4.0))
    np.testing.assert_allclose(smoothed(steady, 60, 3.0)[15:45], steady[15:45], atol=3e-3)

    def unrest(poses: NDArray) -> float:
        return float(np.abs(np.diff(centres(poses), n=2, axis=0))[10:-10].max())

    assert unrest(smoothed(trembling, 60, 4.0)) < 0.1 * unrest(trembling)


@pytest.mark.parametrize("deviation", [0.0, 1e-4])
def test_without_smoothing_the_recorded_poses_come_back(deviation: float) -> None:
    poses = ring(np.linspace(0, 1, 7), inwards=True)
    np.testing.assert_allclose(smoothed(poses, 7, deviation), poses, atol=1e-9)


CODECS = {".mp4": "h264", ".webm": "vp9"}


@pytest.mark.parametrize("size", [(48, 64), (49, 65), (1, 1)])
@pytest.mark.parametrize("suffix", VIDEO_SUFFIXES)
def test_a_video_is_as_players_expect_and_keeps_the_colours(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], suffix: str, size: tuple[int, int]
) -> None:
    rng = np.random.default_rng(1)
    colours = rng.integers(30, 226, (12, 1, 1, 3), dtype=np.uint8)
    path = tmp_path / f"film{suffix}"
    write_video(path, np.tile(colours, (1, *size, 1)), 12.5)
    assert capfd.readouterr() == ("", "")
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        context = stream.codec_context
        assert (context.name, context.pix_fmt, float(stream.average_rate or 0)) == (CODECS[suffix], "yuv420p", 12.5)
        assert (context.height, context.width) == tuple(max(side // 2 * 2, 2) for side in size)
        # ITU-T H.273: 1 is BT.709; 1 is luma from 16 to 235.
        assert (context.colorspace, context.color_primaries, context.color_trc, context.color_range) == (1, 1, 1, 1)
        luma = np.stack([frame.to_ndarray()[: context.height] for frame in file.decode(stream)]).astype(np.float64)
    assert len(luma) == len(colours)
    exact = 16 + 219 * (colours[:, 0, 0] / 255.0 @ [0.2126, 0.7152, 0.0722])
    # One colour a picture: the codecs keep it to a level or so, and truncation would show in the mean.
    error = luma.mean(axis=(1, 2)) - exact
    assert np.abs(error).max() < 2
    assert abs(error.mean()) < 0.4
    if suffix == ".mp4":  # a browser needs the index before it can play
        content = path.read_bytes()
        assert content.index(b"moov") < content.index(b"mdat")


@pytest.mark.parametrize("suffix", VIDEO_SUFFIXES)
def test_a_video_that_fails_leaves_nothing(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(InputError, match="missing"):
        write_video(tmp_path / "missing" / f"film{suffix}", [np.zeros((8, 8, 3), np.uint8)], 10)

    def pictures():
        yield np.zeros((8, 8, 3), np.uint8)
        raise InputError("no more")

    with pytest.raises(InputError, match="no more"):
        write_video(tmp_path / f"film{suffix}", pictures(), 10)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", VIDEO_SUFFIXES)
def test_a_full_disk_is_said(tmp_path: Path, suffix: str) -> None:
    resource = pytest.importorskip("resource")
    noise = np.random.default_rng(0).integers(0, 256, (8, 48, 64, 3), dtype=np.uint8)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, limits[1]))  # larger files fail, as on a full disk
    try:
        with pytest.raises(InputError, match="cannot be written"):
            write_video(tmp_path / f"film{suffix}", noise, 10)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


@pytest.fixture
def copied(finished: Path, tmp_path: Path) -> Path:
    return shutil.copytree(finished, tmp_path / "out")


def keep_images(out: Path) -> None:
    """Add the images to the run's folder, as `export.images` does."""
    for name, frame in zip(open_run(out).names, open_tracker(load_scene(out / "config.yaml")), strict=True):
        write_image(out / "colmap", name, frame)


def forget_the_camera(out: Path) -> None:
    """Leave out of the run's folder what its images are read by without the tracker."""
    text = (out / "frames.json").read_text()
    (out / "frames.json").write_text(text[: text.index(',\n "stored_camera"')] + "}\n")


@pytest.mark.slow
def test_kept_pictures_come_first_with_their_masks(copied: Path) -> None:
    keep_images(copied)
    name = open_run(copied).names[2]
    mask = np.full((60, 80), 255, dtype=np.uint8)
    mask[:, :30] = 0
    (copied / "colmap" / "masks").mkdir()
    cv2.imwrite(str(copied / "colmap" / "masks" / f"{name}.png"), mask)
    config = (copied / "config.yaml").read_text()
    (copied / "config.yaml").write_text(config.replace("/images", "/gone"))
    found = list(pictures(open_run(copied)))
    stored = open_tracker(load_scene(copied / "config.yaml", [f"source.path={copied}/colmap/images"]))
    for picture, frame in zip(found, stored, strict=True):
        np.testing.assert_allclose(picture.image, frame.image, atol=1e-6)
    assert [picture.mask is None for picture in found] == [i != 2 for i in range(9)]
    np.testing.assert_array_equal(found[2].mask, mask > 0)
    (copied / "colmap" / "images" / name).unlink()
    with pytest.raises(InputError, match=r"\.png"):
        list(pictures(open_run(copied)))


@pytest.mark.slow
@pytest.mark.parametrize("way", ["source", "tracker", "kept"])
def test_frames_are_those_of_the_tracker_at_their_refined_poses(copied: Path, way: str) -> None:
    tracked = list(open_tracker(load_scene(copied / "config.yaml")))
    if way == "tracker":
        forget_the_camera(copied)
    elif way == "kept":
        keep_images(copied)
    run = open_run(copied)
    for places in (range(9), [2, 4, 7]):
        for frame, place in zip(frames_of(run, places), places, strict=True):
            assert (frame.index, frame.name, frame.held_out) == (place, run.names[place], place in (0, 4, 8))
            np.testing.assert_array_equal(frame.rgba, tracked[place].rgba)
            np.testing.assert_array_equal(frame.T_camera_world, run.poses[place])


@pytest.mark.slow
@pytest.mark.parametrize(("old", "new"), [("  stop: null", "  stop: 8"), ("  start: 0", "  start: 1")])
def test_another_source_is_told(copied: Path, old: str, new: str) -> None:
    config = (copied / "config.yaml").read_text()
    (copied / "config.yaml").write_text(config.replace(old, new))
    with pytest.raises(InputError, match="frames"):
        list(pictures(open_run(copied)))


@pytest.mark.slow
def test_frames_have_the_refined_poses_and_the_tracked_points(finished: Path) -> None:
    run, tracked = open_run(finished), list(open_tracker(load_scene(finished / "config.yaml")))
    earlier = FinishedFrames(run)
    assert (len(earlier), earlier.size, earlier.end) == (9, (80, 60), pytest.approx(0.8))
    frames = list(earlier)
    for frame, before in zip(frames, tracked, strict=True):
        np.testing.assert_array_equal(frame.T_camera_world, run.poses[frame.index])
        assert (frame.name, frame.timestamp) == (before.name, pytest.approx(before.timestamp))
        assert len(frame.points) == len(before.points) and (frame.points.ids < 0).all()
        np.testing.assert_allclose(frame.points.pixels, before.points.pixels, atol=1e-4)
    seen = {i: xyz for frame in frames for i, xyz in zip(frame.points.ids.tolist(), frame.points.xyz, strict=True)}
    assert len(seen) == len({i for frame in tracked for i in frame.points.ids.tolist()})

"""The pictures and frames of finished runs, read again in their order."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_tracker
from modp_ti.outputs.formats.dataset import write_image
from modp_ti.outputs.playback.finished_run import open_run
from modp_ti.outputs.playback.run_frames import FinishedFrames, frames_of, pictures

pytestmark = pytest.mark.slow


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


@pytest.mark.parametrize(("old", "new"), [("  stop: null", "  stop: 8"), ("  start: 0", "  start: 1")])
def test_another_source_is_told(copied: Path, old: str, new: str) -> None:
    config = (copied / "config.yaml").read_text()
    (copied / "config.yaml").write_text(config.replace(old, new))
    with pytest.raises(InputError, match="frames"):
        list(pictures(open_run(copied)))


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

"""A few damaged images and lines in the midst of a recording are left out and counted; many are refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from fields.geometry.se3 import exp_se3
from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.outputs.formats.trajectory import write_trajectory

COUNT, FPS = 30, 10.0
POSES = [exp_se3([0.02 * i, 0, 0, 0, 0.01 * i, 0]) for i in range(COUNT)]
SCENE = f"""
source: {{path: images, fps: {FPS}, holdout: 4, intrinsics: {{fx: 40, cx: 24, cy: 18}}}}
tracker: {{kind: tum, path: poses.txt, points: points.txt}}
output: out
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    (tmp_path / "images").mkdir()
    for i in range(COUNT):
        cv2.imwrite(str(tmp_path / "images" / f"{i:04d}.png"), rng.integers(0, 255, (36, 48, 3), dtype=np.uint8))
    write_trajectory(tmp_path / "poses.txt", np.arange(COUNT) / FPS, POSES)
    points = np.c_[rng.uniform(-1, 1, (40, 2)), rng.uniform(2, 3, 40)]
    np.savetxt(tmp_path / "points.txt", points)
    (tmp_path / "scene.yaml").write_text(SCENE)
    return tmp_path


def opened(folder: Path) -> ReplayedTracker:
    tracker = open_tracker(load_scene(folder / "scene.yaml"))
    assert isinstance(tracker, ReplayedTracker)
    return tracker


def damage(folder: Path, i: int, how: str = "cut off") -> None:
    file = folder / "images" / f"{i:04d}.png"
    data = bytearray(file.read_bytes())
    if how == "cut off":
        data = data[:-200]
    else:  # the compressed pixels, the headers being whole
        data[60:200] = bytes(140)
    file.write_bytes(data)


def change_line(folder: Path, i: int, line: str) -> None:
    lines = (folder / "poses.txt").read_text().splitlines()
    lines[i + 1] = line  # below the heading
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("how", ["cut off", "spoilt within"])
def test_damaged_images_are_left_out_and_reported_once(folder: Path, how: str) -> None:
    damage(folder, 6, how)
    damage(folder, 8, how)
    tracker = opened(folder)
    kept = [i for i in range(COUNT) if i not in (6, 8)]
    names = [f"{i:04d}.png" for i in kept]
    frames = list(tracker)
    assert [frame.name for frame in frames] == names
    assert [frame.index for frame in frames] == list(range(COUNT - 2))
    # The frames that are held out are the same ones as of a recording in order.
    assert [frame.name for frame in frames if frame.held_out] == [f"{i:04d}.png" for i in kept if i % 4 == 0]
    for frame, i in zip(frames, kept, strict=True):
        np.testing.assert_allclose(frame.T_camera_world, POSES[i], atol=1e-12)
    assert [name for name, _ in tracker.pictures([*names, "0006.png"])] == names
    said = [note for note in tracker.notes if "damaged" in note]
    assert len(said) == 1 and f"2 of {COUNT}" in said[0] and str(folder / "images" / "0006.png") in said[0]


def test_many_images_that_are_cut_off_are_refused_before_the_first_frame(folder: Path) -> None:
    for i in range(5, 9):
        damage(folder, i)
    with pytest.raises(InputError, match=r"0005\.png: unreadable image: the file is cut off"):
        opened(folder)


def test_many_images_that_are_spoilt_within_end_the_run(folder: Path) -> None:
    for i in range(5, 9):
        damage(folder, i, "spoilt within")
    tracker = opened(folder)
    with pytest.raises(InputError, match=r"0005\.png: unreadable image"):
        list(tracker)


@pytest.mark.parametrize(
    "line",
    ["0.7 nan nan nan nan nan nan nan", "0.05 0 0 0 0 0 0 1", "9000 0 0 0 0 0 0 1", "0.6 0 0 inf 0 0 0 1"],
    ids=["nan", "back in time", "far ahead", "infinite"],
)
def test_a_line_that_is_no_pose_costs_its_frame_alone(folder: Path, line: str) -> None:
    change_line(folder, 7, line)
    tracker = opened(folder)
    assert [frame.name for frame in tracker] == [f"{i:04d}.png" for i in range(COUNT) if i != 7]
    assert f"1 of {COUNT} lines of poses.txt hold NaN or a time out of order: left out" in tracker.notes
    for frame in tracker:
        np.testing.assert_allclose(frame.T_camera_world, POSES[int(frame.name[:4])], atol=1e-12)


@pytest.mark.parametrize(
    ("line", "said"), [("{0} nan 0 0 0 0 0 1", r"poses\.txt:7: holds NaN"), ("0 0 0 0 0 0 0 1", "does not lie after")]
)
def test_many_such_lines_are_refused(folder: Path, line: str, said: str) -> None:
    for i in range(5, 9):
        change_line(folder, i, line.format(i / FPS))
    with pytest.raises(InputError, match=said):
        opened(folder)

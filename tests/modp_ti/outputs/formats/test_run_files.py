"""A run's files are read as they were written, and damaged ones are named in one line.

`tests/modp_ti/test_written_and_read.py` has the round trips of frames, scores and trajectories.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modp_ti.files.errors import InputError
from modp_ti.outputs.evaluation import FrameScore
from modp_ti.outputs.formats.run_files import (
    read_exposures,
    read_frames,
    read_masks,
    read_scores,
    write_exposures,
    write_frames,
    write_masks,
    write_scores,
)
from modp_ti.outputs.formats.trajectory import read_trajectory, write_trajectory

SCORES = [
    FrameScore(0, 'images/a, "b".png', True, "online", 1 / 3, 0.1 + 0.2, None, 2 / 3),
    FrameScore(11, "ü.png", False, "refined", 30.5, 1.0, 1e-7),
]


def poses(count: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, random_state=4).as_matrix()
    T[: min(count, 3), :3, :3] = [np.diag(axes) for axes in ((1, -1, -1), (-1, 1, -1), (-1, -1, 1))][:count]
    T[:, :3, 3] = rng.normal(size=(count, 3)) * np.logspace(-3, 4, count)[:, None]
    return T


def test_exposures(tmp_path: Path) -> None:
    exposures = [np.arange(12).reshape(3, 4) / 7 + i for i in range(3)]
    path = tmp_path / "exposure.json"
    assert read_exposures(path) == {}
    write_exposures(path, [0, 1, 2, 5], [0.0, 0.1, 0.2, 0.5], [*exposures, None], keyframes={1})
    frames, found = json.loads(path.read_text())["frames"], read_exposures(path)
    assert [frame["timestamp"] for frame in frames] == [0.0, 0.1, 0.2, 0.5]
    assert [frame["keyframe"] for frame in frames] == [False, True, False, False]
    assert list(found) == [0, 1, 2, 5]
    for index, exposure in enumerate(exposures):
        np.testing.assert_allclose(found[index], exposure, atol=1e-6)
    np.testing.assert_array_equal(found[5], np.eye(3, 4))


def test_masks(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    masks = {place: rng.integers(0, 256, (9, 12), dtype=np.uint8) for place in (0, 7, 1_000_000)}
    assert read_masks(tmp_path / "masks") == {}
    write_masks(tmp_path / "masks", masks)
    found = read_masks(tmp_path / "masks")
    assert list(found) == list(masks)
    for place, mask in masks.items():
        np.testing.assert_array_equal(found[place], mask)


def test_scores_are_a_table_with_named_columns(tmp_path: Path) -> None:
    write_scores(tmp_path / "scores.csv", SCORES)
    assert read_scores(tmp_path / "scores.csv") == SCORES
    lines = (tmp_path / "scores.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "index,name,held_out,stage,psnr,ssim,lpips,detail"
    assert lines[2] == "11,ü.png,0,refined,30.5,1.0,1e-07,"


def test_a_trajectory_has_the_camera_in_the_world_with_the_quaternion_s_real_part_last(tmp_path: Path) -> None:
    T, times = poses(50), 1305031102.175304 + np.arange(50) / 30
    path = tmp_path / "t.txt"
    write_trajectory(path, times, T)
    assert path.read_text().startswith("#")
    table, T_world_camera = np.loadtxt(path), np.linalg.inv(T)
    np.testing.assert_allclose(table[:, 1:4], T_world_camera[:, :3, 3], rtol=1e-9)
    np.testing.assert_allclose(Rotation.from_quat(table[:, 4:]).as_matrix(), T_world_camera[:, :3, :3], atol=1e-12)
    read_times, read_T = read_trajectory(path)
    np.testing.assert_array_equal(read_times, times)
    np.testing.assert_allclose(read_T[:, :3, :3], T[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(read_T[:, :3, 3], T[:, :3, 3], rtol=1e-12, atol=1e-9)


def test_nothing_is_left_of_a_trajectory_with_a_bad_pose(tmp_path: Path) -> None:
    T = poses(3)
    T[1, 0, 0] = np.nan
    for times, motions in ((range(3), T), (range(2), poses(3))):
        with pytest.raises(ValueError):
            write_trajectory(tmp_path / "t.txt", times, motions)
    assert list(tmp_path.iterdir()) == []


FRAMES = {"near": 0.1, "scene_depth": 2.0, "keyframes": [1], "held_out": [0]}
TRAJECTORY, HEADER = b"# comment\n0 1 2 3 0 0 0 1\n\n", b"index,name,held_out,stage,psnr,ssim,lpips,detail\n"
READERS: dict[str, Callable[[Path], object]] = {
    "t.txt": read_trajectory,
    "scores.csv": read_scores,
    "exposure.json": read_exposures,
    "frames.json": lambda path: read_frames(path, 5),
    "000003.png": lambda path: read_masks(path.parent),
}
DAMAGED = [
    *(("t.txt:4", TRAJECTORY + line) for line in (b"1 2 3", b"0 0 0 0 0 0 0 x", b"0 0 0 0 0 0 0 nan")),
    *(("t.txt:4", TRAJECTORY + line) for line in (b"0 0 0 0 0 0 0 0", b"0 0 0 0 0 0 0 1 5")),
    *(("scores.csv:2", HEADER + line) for line in (b"1,a,0,online,30", b"1,a,0,online,30,0.5,")),
    *(("scores.csv:2", HEADER + line) for line in (b"1,a,0,online,x,0.5,,", b"1,a,yes,online,30,0.5,,")),
    ("scores.csv:1", b"a,b\n"),
    ("exposure.json", b'{"frames": [{}]}'),
    *(
        ("exposure.json", json.dumps({"frames": [{"index": 0, "matrix": matrix}]}).encode())
        for matrix in ([1, 2], "x", [[1e300] * 4] * 3)
    ),
    *(
        ("frames.json", json.dumps(FRAMES | bad).encode())
        for bad in ({"near": 0}, {"keyframes": []}, {"held_out": [5]}, {"held_out": None}, {"origin": [1, 2]})
    ),
    ("frames.json", json.dumps(FRAMES | {"stored_camera": {}}).encode()),
    *((name, content) for name in READERS if name != "t.txt" for content in (b"", b"\xff\xfe", b"[]")),
]


@pytest.mark.parametrize(("named", "content"), DAMAGED)
def test_a_damaged_file_is_named_with_its_line(tmp_path: Path, named: str, content: bytes) -> None:
    name = named.partition(":")[0]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=named) as caught:
        READERS[name](tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["t.txt", "scores.csv", "frames.json"])
def test_a_missing_file_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=name):
        READERS[name](tmp_path / name)


def test_frames_know_their_lens_and_origin(tmp_path: Path) -> None:
    path = tmp_path / "frames.json"
    write_frames(path, 0.1, 2.0, {3, 1}, {0}, None, np.array([1e6, 0.25, -3.0]))
    record = read_frames(path, 5)
    assert (record.keyframes, record.held_out, record.stored_camera) == ([1, 3], [0], None)
    assert record.origin.tolist() == [1e6, 0.25, -3.0]

"""Trajectories in the TUM format go out and come back exactly, in the convention that other tools read."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.trajectory import read_trajectory, write_trajectory


def poses(count: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, random_state=4).as_matrix()
    T[:, :3, 3] = rng.normal(size=(count, 3)) * np.logspace(-3, 4, count)[:, None]
    return T


def test_poses_and_times_come_back(tmp_path):
    T = poses(50)
    times = 1305031102.175304 + np.arange(50) / 30
    write_trajectory(tmp_path / "t.txt", times, T)
    read_times, read_T = read_trajectory(tmp_path / "t.txt")
    assert np.array_equal(read_times, times)
    np.testing.assert_allclose(read_T[:, :3, :3], T[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(read_T[:, :3, 3], T[:, :3, 3], rtol=1e-12, atol=1e-9)


def test_half_turns_come_back(tmp_path):
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, :3] = [np.diag([1, -1, -1]), np.diag([-1, 1, -1]), np.diag([-1, -1, 1])]
    write_trajectory(tmp_path / "t.txt", range(3), T)
    np.testing.assert_allclose(read_trajectory(tmp_path / "t.txt")[1], T, atol=1e-12)


def test_lines_hold_the_camera_in_the_world_with_the_quaternion_s_real_part_last(tmp_path):
    T = poses(5)
    write_trajectory(tmp_path / "t.txt", np.arange(5), T)
    table = np.loadtxt(tmp_path / "t.txt")
    assert (tmp_path / "t.txt").read_text().startswith("#")
    T_world_camera = np.linalg.inv(T)
    np.testing.assert_allclose(table[:, 1:4], T_world_camera[:, :3, 3], rtol=1e-12)
    np.testing.assert_allclose(Rotation.from_quat(table[:, 4:]).as_matrix(), T_world_camera[:, :3, :3], atol=1e-12)


def test_nothing_is_left_of_a_trajectory_with_a_bad_pose(tmp_path):
    T = poses(3)
    T[1, 0, 0] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        write_trajectory(tmp_path / "t.txt", range(3), T)
    with pytest.raises(ValueError, match="argument"):
        write_trajectory(tmp_path / "t.txt", range(2), poses(3))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "line", ["1 2 3", "0 0 0 0 0 0 0 x", "0 0 0 0 0 0 0 nan", "0 0 0 0 0 0 0 0", "0 0 0 0 0 0 0 1 5"]
)
def test_bad_line_is_named_with_its_number(tmp_path, line):
    (tmp_path / "t.txt").write_text(f"# comment\n0 1 2 3 0 0 0 1\n\n{line}\n")
    with pytest.raises(InputError, match=r"t\.txt:4: "):
        read_trajectory(tmp_path / "t.txt")


def test_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"no\.txt"):
        read_trajectory(tmp_path / "no.txt")


def test_comments_commas_and_no_poses_are_read(tmp_path):
    (tmp_path / "t.txt").write_text("# time\n1.5, 1, 2, 3, 0, 0, 0, 1 # one\n")
    times, T = read_trajectory(tmp_path / "t.txt")
    assert times.tolist() == [1.5]
    np.testing.assert_allclose(T[0], [[1, 0, 0, -1], [0, 1, 0, -2], [0, 0, 1, -3], [0, 0, 0, 1]])
    (tmp_path / "e.txt").write_text("# nothing\n")
    assert read_trajectory(tmp_path / "e.txt")[1].shape == (0, 4, 4)

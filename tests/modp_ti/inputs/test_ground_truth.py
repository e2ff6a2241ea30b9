"""The true trajectory of a recording: which frames get a pose, and what scoring makes of frames without one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modp_ti.files.errors import InputError
from modp_ti.inputs.protocol import Before
from modp_ti.inputs.timed_poses import open_ground_truth, true_poses
from modp_ti.outputs.evaluation import absolute_trajectory_error


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "truth.txt"
    path.write_text("".join(f"{i / 10} {i} {i * i} 0 0 0 0 1\n" for i in range(6)))
    return path


def test_frames_get_the_pose_of_their_time_and_others_do_not_count(file: Path) -> None:
    truth = open_ground_truth(file)
    assert truth is not None
    poses, note = true_poses(truth, [0.0, 0.101, 0.25, 0.3, 0.5])
    assert [-pose[0, 3] for pose in poses] == pytest.approx([0, 1, np.nan, 3, 5], nan_ok=True)
    assert note is not None and note.startswith("1 of 5 frames")
    estimate = [np.eye(4) if np.isnan(pose).any() else pose for pose in poses]
    assert absolute_trajectory_error(estimate, poses) == pytest.approx(0.0, abs=1e-9)


def test_times_that_do_not_match_leave_the_errors_empty(file: Path) -> None:
    truth = open_ground_truth(file)
    assert truth is not None and true_poses(truth, [0.0, 1.0, 2.0])[0] == []


def test_frames_of_an_earlier_map_have_no_true_pose_and_the_others_that_of_their_own_time(file: Path) -> None:
    truth = open_ground_truth(file)
    assert truth is not None
    poses, note = true_poses(truth, [0.0, 0.1, 10.1, 10.2, 10.4], Before(frames=2, shift=10.0))
    assert [-pose[0, 3] for pose in poses] == pytest.approx([np.nan, np.nan, 1, 2, 4], nan_ok=True)
    assert note is None


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    assert open_ground_truth(None) is None
    with pytest.raises(InputError, match=r"source\.ground_truth"):
        open_ground_truth(tmp_path / "none.txt")

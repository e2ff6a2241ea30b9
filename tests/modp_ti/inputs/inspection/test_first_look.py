"""Before it maps, a run refuses poses that cannot be those of the images, and lets pass those that are not exact."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fields.geometry.se3 import exp_se3
from modp_ti.files.errors import InputError
from modp_ti.inputs.inspection.geometry import require_fitting
from modp_ti.inputs.replay import ReplayedTracker
from tests.opening import opened
from tests.samples.filmed import Filmed, write_text
from tests.samples.kinds import write_sample


def tracked(filmed: Filmed, folder: Path, poses: list[np.ndarray], wxyz: bool = False) -> ReplayedTracker:
    """The plane with these poses (4, 4), camera to world, as a trajectory of `tum`."""
    views = [view.posed(T) for view, T in zip(filmed.views, poses, strict=True)]
    around = np.random.default_rng(0).uniform(-30, 30, (4000, 3))  # some are seen from wherever the poses are
    posed = Filmed(views, around, filmed.names)
    write_sample("tum", folder, posed)
    if wxyz:
        words = [line.split() for line in posed.tum_lines()]
        write_text(folder / "trajectory.txt", [" ".join([*row[:4], row[7], *row[4:7]]) for row in words])
    return opened(folder)


def test_right_poses_and_those_of_a_noisy_tracker_pass(filmed, tmp_path) -> None:
    poses, rng = [view.T_world_camera for view in filmed.views], np.random.default_rng(1)
    require_fitting(tracked(filmed, tmp_path / "right", poses))
    noise = [exp_se3([*rng.normal(0, 0.02, 3), *rng.normal(0, 0.005, 3)]) for _ in poses]
    require_fitting(tracked(filmed, tmp_path / "noisy", [T @ xi for T, xi in zip(poses, noise, strict=True)]))


@pytest.mark.parametrize("fault", ["wxyz", "inverse", "shuffled"])
def test_poses_of_something_else_are_refused_in_one_line(filmed, tmp_path, fault: str) -> None:
    poses = np.stack([view.T_world_camera for view in filmed.views])
    wrong = {"wxyz": poses, "inverse": np.linalg.inv(poses), "shuffled": poses[[3, 0, 6, 1, 5, 2, 4]]}[fault]
    if fault == "inverse":
        wrong[:, :3, 3] += [0.0, 0.0, 0.1]
    with pytest.raises(InputError, match="--force") as caught:
        require_fitting(tracked(filmed, tmp_path / "a", list(wrong), wxyz=fault == "wxyz"))
    assert "\n" not in str(caught.value)

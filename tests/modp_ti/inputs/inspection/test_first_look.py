"""Before it maps, a run refuses poses that cannot be those of the images, and lets pass those that are not exact."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fields.geometry.se3 import exp_se3
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.inputs.inspection.geometry import require_fitting
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.replay import ReplayedTracker


def tracked(scene, poses: np.ndarray, wxyz: bool = False) -> ReplayedTracker:
    """The scene with these poses (N, 4, 4), camera to world, as a trajectory of `tum`."""
    lines = []
    for i, T in enumerate(poses):
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        numbers = [i / 30, *T[:3, 3], *((w, x, y, z) if wxyz else (x, y, z, w))]
        lines.append(" ".join(f"{number:.9f}" for number in numbers))
    root = scene.folder.parent
    (root / "trajectory.txt").write_text("\n".join(lines) + "\n")
    around = np.random.default_rng(0).uniform(-30, 30, (4000, 3))  # some are seen from wherever the poses are
    np.savetxt(root / "points.txt", around)
    K = scene.K
    source = {"path": scene.folder, "intrinsics": {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}}
    tracker = {"kind": "tum", "path": root / "trajectory.txt", "points": root / "points.txt"}
    opened = open_tracker(SceneConfig.model_validate({"source": source, "tracker": tracker, "output": root / "out"}))
    assert isinstance(opened, ReplayedTracker)
    return opened


def test_right_poses_and_those_of_a_noisy_tracker_pass(plane_scene) -> None:
    poses = np.linalg.inv(plane_scene.T_camera_world)
    require_fitting(tracked(plane_scene, poses))
    rng = np.random.default_rng(1)
    noise = [exp_se3([*rng.normal(0, 0.02, 3), *rng.normal(0, 0.005, 3)]) for _ in poses]
    require_fitting(tracked(plane_scene, np.stack([T @ xi for T, xi in zip(poses, noise, strict=True)])))


@pytest.mark.parametrize("fault", ["wxyz", "inverse", "shuffled"])
def test_poses_of_something_else_are_refused_in_one_line(plane_scene, fault: str) -> None:
    poses = np.linalg.inv(plane_scene.T_camera_world)
    wrong = {"wxyz": poses, "inverse": np.linalg.inv(poses), "shuffled": poses[[3, 0, 6, 1, 5, 2, 4]]}[fault]
    if fault == "inverse":
        wrong[:, :3, 3] += [0.0, 0.0, 0.1]
    with pytest.raises(InputError, match="--force") as caught:
        require_fitting(tracked(plane_scene, wrong, wxyz=fault == "wxyz"))
    assert "\n" not in str(caught.value)

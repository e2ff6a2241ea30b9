from __future__ import annotations

import numpy as np

from modp_ti.inputs.multiview.point_solving import ENOUGH, surest_points
from modp_ti.inputs.multiview.reprojection import Observations


def test_what_a_held_out_frame_sees_does_not_choose_the_points_of_others() -> None:
    """A held-out frame that sees less than ENOUGH sure points gets no unsure ones, which others would get as well."""
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = [0.0, 0.1, 0.2, 0.05]
    solves = np.array([True, True, True, False])
    near, far = 2 * ENOUGH, 30  # 5.7 and 0.6 degrees of parallax
    xyz = np.c_[rng.uniform(-0.5, 0.5, (near + far, 2)), np.repeat([2.0, 20.0], [near, far])]

    def seen(held_out: list[int]) -> Observations:
        """Everything in the three solving frames, and some of it in the held-out one."""
        point = np.concatenate([np.tile(np.arange(len(xyz)), 3), held_out]).astype(np.int64)
        frame = np.repeat([0, 1, 2, 3], [len(xyz)] * 3 + [len(held_out)])
        local = xyz[point] + poses[frame, :3, 3]
        return Observations(frame, point, local[:, :2] / local[:, 2:], np.full(len(point), 1e-3))

    alone, _ = surest_points(poses, seen([]), xyz, solves)
    beside, _ = surest_points(poses, seen([0, 1, near, near + 1]), xyz, solves)
    assert len(alone) == near
    assert np.array_equal(alone, beside)

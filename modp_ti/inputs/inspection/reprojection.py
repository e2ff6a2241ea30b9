"""Reprojection errors of the tracked points under each convention of poses and intrinsics."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from modp_ti.inputs.inspection.conventions import Convention

__all__ = ["COMPUTED", "reprojection_errors"]

# Pixels with a smaller error [px] were computed from the points and prove nothing.
COMPUTED = 1e-3


def reprojection_errors(frame: TrackedFrame, convention: Convention) -> NDArray[np.float32]:
    """Reprojection errors (N,) [px] of a frame's points; infinite for points behind the camera.

    Args:
        frame: The frame, with N points.
        convention: The interpretation of its pose and camera.
    """
    T, camera = convention.pose(frame.T_camera_world), convention.camera(frame.camera)
    p = frame.points.xyz @ T[:3, :3].T + T[:3, 3]
    errors = np.full(len(p), np.inf, dtype=np.float32)
    before = p[:, 2] > 1e-9
    errors[before] = np.linalg.norm(camera.project(p[before]) - frame.points.pixels[before], axis=1)
    return errors

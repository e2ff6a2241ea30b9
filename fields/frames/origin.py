"""The origin of a map whose world is far away, such as UTM or ECEF coordinates, where float32 has no digits left."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.se3 import camera_centres

NO_ORIGIN = np.zeros(3)

Event = TypeVar("Event", TrackedFrame, PoseCorrection)

# A camera is far from its world's origin at this many times the depth of its points: there, a step of float32 is a
# thirtieth of a pixel. Without points, the depth is taken as UNKNOWN.
FAR = 1e3
UNKNOWN = 1e2


def far_origin(T_camera_world: NDArray[np.float64], points: SparsePoints) -> NDArray[np.float64]:
    """Return a round place (3,) near the camera of a recording's first frame if that is far away, otherwise zeros."""
    depths = points.depths(T_camera_world)
    reach = float(np.median(depths[depths > 0])) if (depths > 0).any() else UNKNOWN
    centre = camera_centres(T_camera_world[None])[0]
    if np.abs(centre).max() <= FAR * reach:
        return NO_ORIGIN
    unit = 10.0 ** np.floor(np.log10(reach))
    return np.round(centre / unit) * unit


def far_centre(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean place (3,) of cameras (N, 4, 4) if it is far away against their distances, otherwise zeros."""
    centres = camera_centres(poses)
    middle = centres.mean(axis=0)
    return middle if np.abs(middle).max() > FAR * max(np.ptp(centres, axis=0).max(), 1.0) else NO_ORIGIN


def shifted_poses(T_camera_world: NDArray[np.float64], offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """T_camera_world (..., 4, 4) of cameras that move with their world by an offset (3,)."""
    if not offset.any():
        return T_camera_world
    moved = T_camera_world.copy()
    moved[..., :3, 3] -= moved[..., :3, :3] @ offset
    return moved


def shifted(event: Event, offset: NDArray[np.float64]) -> Event:
    """Return a frame or a correction whose world moves by an offset (3,)."""
    if not offset.any():
        return event
    T = shifted_poses(event.T_camera_world, offset)
    if isinstance(event, TrackedFrame):
        return replace(event, T_camera_world=T, points=replace(event.points, xyz=event.points.xyz + offset))
    return replace(event, T_camera_world=T, xyz=event.xyz + offset)

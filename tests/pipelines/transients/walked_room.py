"""A recording of the room in which a person walks, with and without the person."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.se3 import inverse_se3
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from tests.room import Room, RoomRecording, pinhole, walk

CAMERA = pinhole(128, 96)
FRAMES, HELD_OUT = 40, 8
SETTINGS = MappingSettings(densify={"warm_up": 2}, optimise={"steps": 6}, levels={"probabilities": (1.0,)})


@dataclass(frozen=True)
class Recording:
    """Frames with and without the person, and where the person is (H, W) in each."""

    still: list[TrackedFrame]
    walked: list[TrackedFrame]
    person: list[NDArray[np.bool_]]


def person_from(
    eye: NDArray[np.float64], rays: NDArray[np.float64], place: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Cast rays at a person, a striped box of 0.5 x 0.5 x 1.7 m on the floor.

    Args:
        eye: Origin (3,) of all rays.
        rays: Directions (N, 3).
        place: Place (2,) on the floor.

    Returns:
        Parameter (N,) of each hit, infinite without one, and colour (N, 3).
    """
    low, high = np.array([*(place - 0.25), 0.0]), np.array([*(place + 0.25), 1.7])
    with np.errstate(divide="ignore"):
        a, b = (low - eye) / rays, (high - eye) / rays
    near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    t = np.where((near < far) & (near > 0), near, np.inf)
    height = eye[2] + np.where(np.isfinite(t), t, 0.0) * rays[:, 2]
    stripes = 0.15 * np.sin(12.0 * height)
    return t, np.stack([0.8 + stripes, 0.25 + stripes, 0.2 - stripes], axis=1)


@cache
def recording() -> Recording:
    room = Room()
    still = RoomRecording(room, CAMERA, walk(FRAMES)).frames()
    u, v = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    walked, person = [], []
    for i, frame in enumerate(still):
        place, T, points = np.array([1.0 - 0.06 * i, 0.2]), frame.T_camera_world, frame.points
        eye = inverse_se3(T)[:3, 3]
        t, colour = person_from(eye, CAMERA.unproject(pixels, np.ones(len(pixels))) @ T[:3, :3], place)
        nearer = (t < room.depth(CAMERA, T, pixels)).reshape(u.shape)
        image = np.where(nearer[..., None], colour.reshape(*u.shape, 3), frame.image).astype(np.float32)
        to_points = CAMERA.unproject(points.pixels, np.ones(len(points))) @ T[:3, :3]
        seen = person_from(eye, to_points, place)[0] > points.depths(T)
        points = SparsePoints(points.xyz[seen], points.pixels[seen], points.ids[seen])
        walked.append(replace(frame, image=image, points=points))
        person.append(nearer)
    return Recording(still, walked, person)


def held_out(frames: list[TrackedFrame]) -> list[TrackedFrame]:
    """The frames that `mapped` leaves out."""
    return frames[HELD_OUT // 2 :: HELD_OUT]


def mapped(frames: list[TrackedFrame], transients: bool) -> OnlineMapper:
    """The map of the frames, without the held-out ones."""
    mapper = OnlineMapper(SETTINGS.model_copy(update={"transients": transients}), CAMERA.width, CAMERA.height, seed=0)
    mapper.compile()
    for frame in frames:
        if frame.index % HELD_OUT != HELD_OUT // 2:
            mapper.process(frame)
    mapper.finish()
    return mapper

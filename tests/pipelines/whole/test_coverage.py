"""Where a map is thin: angles against plain geometry, and unseen views of a room against the truth."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from fields.runtime.backend import initialise
from pipelines.online import OnlineMapper
from pipelines.render.renderer import RenderedView
from pipelines.settings import MappingSettings
from pipelines.whole.coverage import THIN, SeenDepth, where_to_film, widest_angles
from tests.room import Room, RoomRecording, look_at, pinhole, walk

CAMERA = pinhole(40, 30)


def before_a_wall(eye: list[float], target: list[float]) -> SeenDepth:
    """What a camera sees of the plane y = 2, which is all that there is."""
    T = look_at(np.array(eye), np.array(target))
    x, y = np.meshgrid(np.arange(40) + 0.5, np.arange(30) + 0.5)
    rays = CAMERA.unproject(np.stack([x.ravel(), y.ravel()], axis=1), np.ones(1200)) @ T[:3, :3]
    z = ((2.0 - eye[1]) / rays[:, 1]).reshape(30, 40)
    return SeenDepth.of(T, CAMERA, RenderedView(np.zeros((30, 40, 3)), z, np.ones((30, 40))))


def test_angles_are_those_between_the_rays_of_the_cameras_that_see_a_point() -> None:
    seen = [before_a_wall([x, 0.0, 0.0], [0.0, 2.0, 0.0]) for x in (-0.3, 0.0, 0.4)]
    points = np.array([[0.0, 2.0, 0.0], [0.0, 1.0, 0.0], [0.0, -5.0, 0.0]])
    angles = widest_angles(points, seen, 2.0)
    assert angles[0] == pytest.approx(np.degrees(np.arctan2(0.3, 2.0) + np.arctan2(0.4, 2.0)), rel=1e-6)
    assert np.isnan(angles[1:]).all()  # before the wall, and behind the cameras


def test_a_far_point_needs_the_same_way_of_the_camera_at_most() -> None:
    """With the scene's depth half as large, the same point asks for half the angle."""
    seen, point = [before_a_wall([x, 0.0, 0.0], [0.0, 2.0, 0.0]) for x in (-0.1, 0.1)], np.array([[0.0, 2.0, 0.0]])
    assert widest_angles(point, seen, 1.0) == pytest.approx(2 * widest_angles(point, seen, 2.01), rel=1e-2)


def test_who_films_from_where_the_arrow_begins_sees_it_from_a_wide_angle() -> None:
    seen = [before_a_wall([x, 0.0, 0.0], [x, 2.0, 0.0]) for x in (0.0, 0.05)]
    x, z = (each.ravel() for each in np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-0.5, 0.5, 11)))
    wall = np.stack([x, np.full(x.size, 2.0), z], axis=1)
    angles = widest_angles(wall, seen, 2.0)
    film = where_to_film(wall, angles, seen)
    assert film is not None
    seen.append(before_a_wall(film[0].tolist(), film[1].tolist()))
    after = widest_angles(wall, seen, 2.0)
    assert np.nanmedian(angles) < THIN and np.nanmedian(after) > THIN
    assert where_to_film(wall, np.full(len(wall), 90.0), seen) is None


def unseen_views(walked: list[NDArray], count: int) -> list[NDArray]:
    """Poses (4, 4) up to a metre beside a walk, that look about where it looked."""
    rng, poses = np.random.default_rng(3), []
    for T in (inverse_se3(walked[i]) for i in rng.integers(len(walked), size=count)):
        eye = np.clip(T[:3, 3] + rng.normal(0, 0.45, 3) * [1, 0.7, 0.6], [-2.3, -1.8, 0.3], [2.3, 0.2, 2.3])
        poses.append(look_at(eye, T[:3, 3] + 2.2 * T[:3, 2] + rng.normal(0, 0.8, 3)))
    return poses


def test_unseen_views_are_at_least_three_decibels_worse_where_the_map_is_thin() -> None:
    room, camera = Room(), pinhole(80, 60)
    recording = RoomRecording(room, camera, walk(24, 0.1), points=400, views=6)
    initialise("cpu")
    mapper = OnlineMapper(MappingSettings(), 80, 60)
    for frame in recording.frames():
        mapper.process(frame)
    mapper.finish()
    renderer, store = mapper.renderer, mapper.keyframes
    poses = [view.T_camera_world for view in store]
    seen = [SeenDepth.of(T, camera, renderer.render(camera, T, mapper.near)) for T in poses]
    x, y = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    errors, angles = [], []
    for T in unseen_views(recording.T_camera_world, 30):
        view, T_world_camera = renderer.render(camera, T, mapper.near), inverse_se3(T)
        errors.append(np.square(np.clip(view.colour, 0, 1) - room.image(camera, T) / 255).mean(axis=2).ravel())
        xyz = camera.unproject(pixels, view.expected_depth().ravel()) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        angles.append(widest_angles(xyz, seen, store.scene_depth))
    error, angle = np.concatenate(errors), np.concatenate(angles)
    thin, rest = error[angle < THIN].mean(), error[angle >= THIN].mean()
    assert (angle < THIN).mean() > 0.01
    assert 10 * np.log10(thin / rest) >= 3.0

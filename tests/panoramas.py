"""Panoramas of the room, from closed forms of the rays of their pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from tests.room import Room, look_at


def equirectangular_rays(height: int) -> NDArray[np.float64]:
    """Rays (H, 2 H, 3) of the pixels' centres by longitude and latitude: x right, y down, z forward."""
    longitude = (np.arange(2 * height) + 0.5) / height * np.pi - np.pi
    latitude = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    return np.stack(
        [np.cos(latitude) * np.sin(longitude), -np.sin(latitude), np.cos(latitude) * np.cos(longitude)], axis=-1
    )


def fisheye_rays(height: int, lens_fov: float) -> NDArray[np.float64]:
    """Rays (H, 2 H, 3) of two equidistant lenses of `lens_fov` degrees; NaN outside their circles."""
    x, y = np.meshgrid((np.arange(height) + 0.5) / height * 2 - 1, (np.arange(height) + 0.5) / height * 2 - 1)
    radius = np.hypot(x, y)
    angle = radius * np.radians(lens_fov) / 2
    aside = np.sin(angle) / np.maximum(radius, 1e-12)
    front = np.stack([aside * x, aside * y, np.cos(angle)], axis=-1)
    front[radius > 1] = np.nan
    return np.concatenate([front, front * (-1.0, 1.0, -1.0)], axis=1)


def panorama(room: Room, T_rig_world: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Image (H, W, 3) of the rays' colours, black where a ray is NaN."""
    flat = rays.reshape(-1, 3)
    seen = np.isfinite(flat).all(axis=1)
    colour = np.zeros_like(flat)
    colour[seen] = room.colours(inverse_se3(T_rig_world)[:3, 3], flat[seen] @ T_rig_world[:3, :3])
    return np.rint(255 * np.clip(colour, 0, 1)).astype(np.uint8).reshape(rays.shape)


def stroll(count: int, step: float = 0.05) -> list[NDArray[np.float64]]:
    """T_rig_world (4, 4) of a camera that is carried through the room, turns a little, and sways."""
    t = step * np.arange(count)
    eyes = np.stack([-1.5 + t, -0.9 + 0.2 * np.sin(1.5 * t), 1.3 + 0.08 * np.sin(3 * t)], axis=1)
    ahead = np.stack([np.cos(0.5 * t), 0.4 + np.sin(0.5 * t), 0.1 * np.sin(2 * t)], axis=1)
    return [look_at(eye, eye + way) for eye, way in zip(eyes, ahead, strict=True)]

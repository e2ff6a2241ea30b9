"""The output folder of a run in the test room, with a map that is computed from the room's geometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from fields.map.gaussians import SH_C0
from fields.map.keyframes import KeyframeStore
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.inputs.sources.distortion import NO_DISTORTION, Distortion
from modp_ti.inputs.sources.undistortion import Undistorter
from modp_ti.outputs.evaluation import MapVersion
from modp_ti.outputs.formats.run_files import write_map
from tests.room import Room, RoomRecording, pinhole, walk

CAMERA = pinhole(240, 180)
NEAR = 0.05
# Deviation of the Gaussians along the surface [px]. They are a pixel apart, and half transparent: opaque ones hide
# those behind them on slanted surfaces, which displaces the colours.
WIDTH = 0.8


def stored_camera(k1: float = 0.0) -> Undistorter:
    """Undistorter of images that were stored at twice the mapped size, by a lens with a radial distortion."""
    double = CAMERA.resized(2 * CAMERA.width, 2 * CAMERA.height)
    return Undistorter(double, Distortion(numerator=(k1,)) if k1 else NO_DISTORTION, 0.5)


def photograph(
    room: Room, camera: PinholeCamera, T_camera_world: NDArray[np.float64], k1: float = 0.0
) -> NDArray[np.uint8]:
    """A picture (H, W, 3) of the room through a lens with radial distortion k1, four rays per pixel."""
    fine = camera.resized(2 * camera.width, 2 * camera.height)
    x, y = np.meshgrid(np.arange(fine.width) + 0.5, np.arange(fine.height) + 0.5)
    lens = Undistorter(fine, Distortion(numerator=(k1,)) if k1 else NO_DISTORTION)
    rays = np.c_[lens.rays(np.stack([x.ravel(), y.ravel()], axis=1)), np.ones(x.size)] @ T_camera_world[:3, :3]
    colour = room.colours(inverse_se3(T_camera_world)[:3, 3], rays)
    colour = colour.reshape(camera.height, 2, camera.width, 2, 3).mean(axis=(1, 3))
    return np.rint(255 * np.clip(colour, 0, 1)).astype(np.uint8)


def painted(room: Room, poses: list[NDArray[np.float64]]) -> dict[str, NDArray[np.float32]]:
    """Flat Gaussians on the surfaces that the poses see, in their true colours, once where several poses see them."""
    found: list[list[NDArray]] = []
    x, y = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    for number, T in enumerate(poses):
        rays = CAMERA.unproject(pixels, np.ones(len(pixels))) @ T[:3, :3]
        eye = inverse_se3(T)[:3, 3]
        colour, t, normal = room.shaded(eye, rays)
        slant = np.abs((normal * rays).sum(axis=1)) / np.linalg.norm(rays, axis=1)
        width = WIDTH * t / CAMERA.focal / np.maximum(slant, 0.3) ** 0.5
        flat = np.log(np.stack([width, width, 0.05 * width], axis=1))
        xyz = eye + t[:, None] * rays
        new = ~np.any([_sees(room, earlier, xyz) for earlier in poses[:number]] or [np.zeros(len(xyz), bool)], axis=0)
        found.append([xyz[new], flat[new], _turned(normal)[new], colour[new]])
    position, log_scale, quaternion, colour = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return {
        "position": position.astype(np.float32),
        "log_scale": log_scale.astype(np.float32),
        "quaternion": quaternion.astype(np.float32),
        "opacity_logit": np.full(len(position), 0.0, np.float32),
        "sh": ((colour - 0.5) / SH_C0).astype(np.float32)[:, None],
    }


def write_run(room: Room, folder: Path, k1: float = 0.0) -> list[NDArray[np.float64]]:
    """Write the output folder of a walk of seven keyframes, and return their T_camera_world."""
    recording = RoomRecording(room, CAMERA, walk(7, step=0.2), points=60)
    store, delivered = KeyframeStore(), DeliveredFrames()
    delivered.trajectory = store.trajectory
    for frame in recording.frames():
        assert isinstance(frame, TrackedFrame)
        store.append(frame)
        delivered.add(frame)
    poses = recording.T_camera_world
    version = MapVersion(painted(room, poses[::3]), poses, [None] * len(poses), 0)
    folder.mkdir(parents=True)
    write_map(folder, version, delivered, delivered.name, store, NEAR, stored_camera(k1))
    (folder / "config.yaml").write_text("# read by other commands only\n")
    return poses


def another_room() -> Room:
    """A room of the same shape with other wallpapers."""
    room = Room()
    room._base, room._lattice = room._base[::-1].copy(), room._lattice[::-1, ::-1, ::-1].transpose(0, 3, 1, 2, 4).copy()
    return room


def _sees(room: Room, T: NDArray[np.float64], xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of the points (N, 3) on surfaces are seen from T."""
    local = xyz @ T[:3, :3].T + T[:3, 3]
    pixels = CAMERA.project(np.where(local[:, 2:] > 0.1, local, [0.0, 0.0, 1.0]))
    return (local[:, 2] > 0.1) & CAMERA.contains(pixels) & (room.depth(CAMERA, T, pixels) > 0.98 * local[:, 2])


def _turned(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternions (N, 4) as (w, x, y, z) that turn the z axis to the normals, or to their opposites."""
    up = np.where(normal[:, 2:] < 0, -normal, normal)
    return np.stack([1 + up[:, 2], -up[:, 1], up[:, 0], np.zeros(len(up))], axis=1)

"""A camera that walks through a box room of textured walls: every pixel sees one wall, its depth is known exactly."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import camera_centres
from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.klt.odometry import Odometry
from modp_ti.inputs.klt.tracking import View
from modp_ti.outputs.evaluation import umeyama
from tests.room import look_at

# Corners of the room [m], texels per metre.
LOW, HIGH = np.array([-3.0, -2.0, 0.0]), np.array([3.0, 3.0, 2.6])
FINENESS = 90


@dataclass(frozen=True)
class BoxRoom:
    """textures: of the six walls, by (axis, side), repeated over them, coarser far away; low, high: corners [m]."""

    camera: PinholeCamera
    textures: dict[tuple[int, int], NDArray[np.uint8]]
    low: NDArray[np.float64] = field(default_factory=lambda: LOW)
    high: NDArray[np.float64] = field(default_factory=lambda: HIGH)
    fineness: float = FINENESS

    def image(self, T: NDArray[np.float64]) -> NDArray[np.uint8]:
        """RGB (H, W, 3) seen from T_camera_world; by ray casting of the box and bilinear lookup of its walls."""
        c = self.camera
        x, y = np.meshgrid(np.arange(c.width) + 0.5, np.arange(c.height) + 0.5)
        rays = np.stack([(x - c.cx) / c.fx, (y - c.cy) / c.fy, np.ones_like(x)], axis=-1) @ T[:3, :3]
        return self.colours(-T[:3, :3].T @ T[:3, 3], rays)

    def colours(self, eye: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.uint8]:
        """RGB (H, W, 3) that rays (H, W, 3) from `eye` see."""
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.where(rays > 0, (self.high - eye) / rays, (self.low - eye) / rays)
        wall = reach.argmin(axis=-1)
        hit = eye + rays * reach.min(axis=-1)[..., None]
        image = np.zeros(rays.shape, np.uint8)
        coarse = np.log2(np.maximum(self.fineness * reach.min(axis=-1) / self.camera.fx, 1.0)).astype(int)
        for (axis, side), texture in self.textures.items():
            mine = (wall == axis) & ((np.take(rays, axis, axis=-1) > 0) == bool(side))
            place = np.stack([(np.take(hit, i, axis=-1) - self.low[i]) * self.fineness for i in range(3) if i != axis])
            for level in np.unique(coarse[mine]).tolist():
                sheet = cv2.resize(texture, None, fx=0.5**level, fy=0.5**level, interpolation=cv2.INTER_AREA)
                zoom = np.array([sheet.shape[i] / texture.shape[i] for i in (1, 0)])[:, None, None]
                u, v = ((place + 0.5) * zoom - 0.5).astype(np.float32)
                seen = cv2.remap(sheet, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
                there = mine & (coarse == level)
                image[there] = seen[there]
        return image

    def mirrored(self) -> BoxRoom:
        """Another place."""
        return replace(self, textures={wall: sheet[::-1].copy() for wall, sheet in self.textures.items()})

    def grey(self, T: NDArray[np.float64]) -> NDArray[np.uint8]:
        return cv2.cvtColor(self.image(T), cv2.COLOR_RGB2GRAY)

    def depth(self, T: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """z (N,) of what is seen at pixels (N, 2)."""
        c = self.camera
        rays = np.c_[(pixels[:, 0] - c.cx) / c.fx, (pixels[:, 1] - c.cy) / c.fy, np.ones(len(pixels))] @ T[:3, :3]
        eye = -T[:3, :3].T @ T[:3, 3]
        return np.where(rays > 0, (self.high - eye) / rays, (self.low - eye) / rays).min(axis=1)


def _texture(rng: np.random.Generator, height: int, width: int) -> NDArray[np.uint8]:
    sheet = np.zeros((height, width, 3), np.float32)
    for size in (5, 12, 40):
        noise = rng.random((height // size + 2, width // size + 2, 3)).astype(np.float32)
        sheet += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(255 * (sheet - sheet.min()) / np.ptp(sheet), 0, 255).astype(np.uint8)


@pytest.fixture(scope="session")
def box_room() -> BoxRoom:
    rng = np.random.default_rng(11)
    size = np.ceil((HIGH - LOW) * FINENESS).astype(int) + 2
    textures = {}
    for axis in range(3):
        u, v = (size[i] for i in range(3) if i != axis)
        for side in range(2):
            textures[axis, side] = _texture(rng, int(v), int(u))
    return BoxRoom(PinholeCamera(270.0, 270.0, 160.0, 120.0, 320, 240), textures)


def walk(frames: int) -> list[NDArray[np.float64]]:
    """T_camera_world (4, 4) of a camera that goes sideways and turns a little, 3 cm a frame."""
    t = np.arange(frames)
    eyes = np.stack([-1.2 + 0.03 * t, -1.2 + 0.1 * np.sin(0.1 * t), 1.3 + 0.05 * np.sin(0.23 * t)], axis=1)
    targets = np.stack([-1.0 + 0.035 * t, np.full(frames, 3.0), 1.0 + 0.04 * np.cos(0.2 * t)], axis=1)
    return [look_at(eye, target) for eye, target in zip(eyes, targets, strict=True)]


def turning_walk(frames: int) -> list[NDArray[np.float64]]:
    """T_camera_world of a camera that first looks at the wall at the side and then turns to the one of `box_walk`."""
    t = np.linspace(0, 1, frames)
    angle = np.radians(10) + np.radians(85) * np.clip(1.3 * t - 0.3, 0, 1)
    eyes = np.stack([-0.8 - 0.3 * t, -0.2 - 0.9 * t, np.full(frames, 1.2)], axis=1)
    aims = eyes + np.stack([np.cos(angle), np.sin(angle), np.full(frames, -0.05)], axis=1)
    return [look_at(eye, aim) for eye, aim in zip(eyes, aims, strict=True)]


def turn_on_the_spot(T: NDArray[np.float64], degrees: float, frames: int) -> list[NDArray[np.float64]]:
    """T_camera_world of a camera that turns to the right from a pose, and then goes sideways for 30 frames."""
    eye, z = -T[:3, :3].T @ T[:3, 3], T[2, :3]
    angle = np.arctan2(z[1], z[0]) - np.radians(degrees) * np.minimum(np.arange(1, frames + 31) / frames, 1.0)
    along = np.array([-np.sin(angle[-1]), np.cos(angle[-1]), 0.0])
    eyes = eye + 0.03 * np.maximum(np.arange(1, frames + 31) - frames, 0)[:, None] * along
    aims = eyes + np.stack([np.cos(angle), np.sin(angle), np.full(len(angle), -0.05)], axis=1)
    return [look_at(eye, aim) for eye, aim in zip(eyes, aims, strict=True)]


@dataclass(frozen=True)
class Walk:
    poses: list[NDArray[np.float64]]
    images: list[NDArray[np.uint8]]

    @property
    def grey(self) -> list[NDArray[np.uint8]]:
        return [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in self.images]

    def written(self, folder: Path) -> Path:
        folder.mkdir(exist_ok=True)
        for i, image in enumerate(self.images):
            cv2.imwrite(str(folder / f"{i:04d}.png"), image[..., ::-1])
        return folder


@pytest.fixture(scope="session")
def box_walk(box_room: BoxRoom) -> Walk:
    poses = walk(60)
    return Walk(poses, [box_room.image(T) for T in poses])


BLACK = np.zeros((240, 320), np.uint8)


def followed(
    box_room: BoxRoom,
    greys: Sequence[NDArray[np.uint8]],
    after: Callable[[int, Odometry], None] = lambda *_: None,
    **settings: Any,
) -> Followed:
    """Follow grey images with the known camera, and call `after` with each number. No frame may come twice."""
    odometry, views, brought = Odometry(Lens.pinhole(box_room.camera), **settings), {}, []
    for number in range(len(greys) + 1):
        found = odometry.process(number, greys[number]) if number < len(greys) else odometry.finish()
        brought.append([view.number for view in found])
        assert not set(brought[-1]) & set(views)
        views |= {view.number: view for view in found}
        after(number, odometry)
    return Followed(odometry, views, brought)


@dataclass(frozen=True)
class Followed:
    """The odometry, all views, and the numbers of the views that each frame and the end brought."""

    odometry: Odometry
    views: dict[int, View]
    brought: list[list[int]]

    def errors(self, truth: Mapping[int, NDArray[np.float64]]) -> NDArray[np.float64]:
        """Distances [m] of camera centres from the true ones after the best similarity."""
        estimate = camera_centres([self.pose(i) for i in truth])
        target = camera_centres(list(truth.values()))
        s, R, t = umeyama(estimate, target)
        return np.linalg.norm(s * estimate @ R.T + t - target, axis=1)

    def pose(self, number: int) -> NDArray[np.float64]:
        assert self.odometry.tracking is not None
        return self.odometry.tracking.pose(self.views[number])

    @property
    def poses(self) -> list[bytes]:
        """All poses, bit for bit."""
        return [self.pose(i).tobytes() for i in sorted(self.views)]

"""Views of a textured plane with known cameras, poses and depths, of which the writers here make recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
DEPTH_SIZE = (64, 48)  # of depth maps (width, height)


@dataclass(frozen=True)
class View:
    """A view of a scene.

    image: (H, W, 3) uint8 BGR. K: (3, 3), pixel centres at +0.5. T_world_camera: (4, 4), OpenCV axes. depth: the depths
    (h, w) [m] of a camera at this pose, by its K and size (w, h).
    """

    image: NDArray[np.uint8]
    K: NDArray[np.float64]
    T_world_camera: NDArray[np.float64]
    depth: Callable[[NDArray[np.float64], tuple[int, int]], NDArray[np.float64]]

    @property
    def size(self) -> tuple[int, int]:
        return self.image.shape[1], self.image.shape[0]

    @property
    def T_camera_world(self) -> NDArray[np.float64]:  # noqa: N802  # a transform is named by its ends
        return np.linalg.inv(self.T_world_camera)

    def depth_map(self) -> NDArray[np.float64]:
        """The depths (h, w) [m] of a small map of the image's field of view."""
        ratio = np.divide(DEPTH_SIZE, self.size)
        return self.depth(np.diag([*ratio, 1.0]) @ self.K, DEPTH_SIZE)

    def posed(self, T_world_camera: NDArray[np.float64]) -> View:
        """The same image, said to be of another pose."""
        return replace(self, T_world_camera=T_world_camera)


@dataclass(frozen=True)
class Filmed:
    """Views at 30 frames a second, points (P, 3) that they see, and the names of their images."""

    views: Sequence[View]
    points: NDArray[np.float64]
    names: Sequence[str]

    @property
    def K(self) -> NDArray[np.float64]:  # noqa: N802  # the usual name of the matrix
        return self.views[0].K

    @property
    def size(self) -> tuple[int, int]:
        return self.views[0].size

    def seen(self, i: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the numbers (N,) of the points that view i contains, and their pixels (N, 2)."""
        p = self.points @ self.views[i].T_camera_world[:3, :3].T + self.views[i].T_camera_world[:3, 3]
        pixels = (p / p[:, 2:] @ self.K.T)[:, :2]
        inside = np.flatnonzero((p[:, 2] > 0) & ((pixels > 0) & (pixels < self.size)).all(axis=1))
        return inside, pixels[inside]

    def moved(self, offset: Sequence[float]) -> Filmed:
        """The same elsewhere in the world."""
        there = np.eye(4)
        there[:3, 3] = offset
        views = [view.posed(there @ view.T_world_camera) for view in self.views]
        return replace(self, views=views, points=self.points + offset)

    def tum_lines(self, first_time: float = 0.0, per_second: float = 30.0) -> list[str]:
        """One line a view: time tx ty tz qx qy qz qw, camera to world."""
        lines = []
        for i, view in enumerate(self.views):
            numbers = [*view.T_world_camera[:3, 3], *quaternion(view.T_world_camera)]
            lines.append(f"{first_time + i / per_second:.6f} " + " ".join(f"{number:.12g}" for number in numbers))
        return lines


def film(count: int, size: tuple[int, int], names: Sequence[str] = ()) -> Filmed:
    """Film the plane z = 0, with blobs of many sizes, from an arc of 25 degrees at distance 4."""
    rng = np.random.default_rng(7)
    texture = np.zeros((800, 1000, 3), np.float32)
    for blob in (4, 8, 16, 40):
        noise = rng.random((800 // blob + 2, 1000 // blob + 2, 3)).astype(np.float32)
        texture += cv2.resize(noise, (1000, 800), interpolation=cv2.INTER_CUBIC)
    texture = np.clip(255 * (texture - texture.min()) / np.ptp(texture), 0, 255).astype(np.uint8)

    shrunk = np.diag([size[0] / 320, size[1] / 240, 1.0])
    K = shrunk @ np.array([[300.0, 0, 161.3], [0, 298.0, 118.6], [0, 0, 1]])
    # Texel with centre at +0.5 -> point of the plane, homogeneous.
    world_texture = np.array([[0.006, 0, -3.0], [0, 0.006, -2.4], [0, 0, 1]])
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])  # to cv2's integer centres
    views = []
    for i, angle in enumerate(np.linspace(-12.5, 12.5, count)):
        R = Rotation.from_euler("yxz", [angle, 0.2 * angle, 3 * np.sin(i)], degrees=True).as_matrix()
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, R @ [0.0, 0.0, 4.0 + 0.1 * i] + [0.05 * i, 0, 0]
        homography = half @ K @ T[:3, [0, 1, 3]] @ world_texture @ np.linalg.inv(half)
        image = np.asarray(cv2.warpPerspective(texture, homography, size, flags=cv2.INTER_AREA), np.uint8)
        views.append(View(image, K, np.linalg.inv(T), lambda K, size, T=T: plane_depth(np.linalg.inv(T), K, size)))
    points = np.c_[np.random.default_rng(5).uniform(-1.6, 1.6, (60, 2)), np.zeros(60)]
    return Filmed(views, points, names or [f"frame-{i:06d}.color.png" for i in range(count)])


def plane_depth(T_world_camera: NDArray, K: NDArray, size: tuple[int, int]) -> NDArray:
    """Depths (h, w) of the plane z = 0 of the world."""
    columns, rows = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones_like(rows)], axis=-1)
    return -T_world_camera[2, 3] / (rays @ T_world_camera[2, :3])


def quaternion(T: NDArray[np.float64]) -> list[float]:
    """The rotation of a pose (4, 4) as (x, y, z, w)."""
    return Rotation.from_matrix(T[:3, :3]).as_quat().tolist()


def rows_of(matrix: NDArray[np.float64]) -> list[str]:
    """The rows of a matrix as text."""
    return [" ".join(f"{value:.12g}" for value in row) for row in matrix]


def write_text(file: Path, lines: Sequence[str]) -> None:
    """Write a text file with these lines, and the folders above it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("".join(line + "\n" for line in lines))


def write_image(file: Path, image: NDArray) -> None:
    """Write an image in the format of its suffix, and the folders above it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), image, [cv2.IMWRITE_JPEG_QUALITY, 98] if file.suffix == ".jpg" else [])


def write_scene(folder: Path, tracker: str, source: str) -> None:
    """Write a `scene.yaml` with this tracker and source."""
    lines = [f"source: {{{source}}}", f"tracker: {{{tracker}}}", "output: out", "device: cpu"]
    write_text(folder / "scene.yaml", lines)

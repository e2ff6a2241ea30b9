"""A small furnished room with known geometry, built from Open3D primitives and ray-cast by Open3D."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3

LOW, HIGH = np.array([-2.5, -2.0, 0.0]), np.array([2.5, 2.0, 2.6])  # corners of the room, z up [m]
CELLS = np.array([0.7, 0.22])  # cell sizes of the textures [m]
LIGHT = np.array([0.3, -0.5, 0.81])
CACHED = 1 << 14  # rays that are shaded together: their arrays stay in a processor's cache


def look_at(eye: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return T_camera_world (4, 4) of a camera at `eye` that looks at `target`, with the world's z up."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z])
    T[:3, 3] = -T[:3, :3] @ eye
    return T


def walk(frames: int, step: float = 0.04) -> list[NDArray[np.float64]]:
    """Return T_camera_world (4, 4) of a camera that moves along the room by `step` metres per frame.

    The camera looks across the room.
    """
    t = step * np.arange(frames)
    eyes = np.stack([-1.4 + t, -1.3 + 0.1 * np.sin(2 * t), 1.3 + 0.08 * np.sin(3 * t)], axis=1)
    targets = np.stack([-0.8 + 0.7 * t, np.full(frames, 1.6), np.full(frames, 0.8)], axis=1)
    return [look_at(eye, target) for eye, target in zip(eyes, targets, strict=True)]


def pinhole(width: int, height: int) -> PinholeCamera:
    """Return the room's camera, with a horizontal field of view of 67 degrees and a centred principal point."""
    return PinholeCamera(0.75 * width, 0.75 * width, width / 2, height / 2, width, height)


class Room:
    """Walls, two boxes, a sphere and a cylinder, each with its own texture.

    Args:
        without: Numbers of the pieces that are not there: 2 is the high box, 3 the sphere.
        contrast: Factor on the contrast of the textures.
    """

    def __init__(self, without: Collection[int] = (), contrast: float = 1.0) -> None:
        import open3d as o3d  # takes seconds, which the collection of the tests would wait for

        self._tensor = o3d.core.Tensor
        make = o3d.t.geometry.TriangleMesh
        pieces = [
            (make.create_box(*(HIGH - LOW)), LOW),
            (make.create_box(1.2, 0.6, 0.7), np.array([-1.2, 0.6, 0.0])),
            (make.create_box(0.5, 0.5, 1.4), np.array([0.9, 1.0, 0.0])),
            (make.create_sphere(0.35, resolution=40), np.array([0.3, 0.5, 0.35])),
            (make.create_cylinder(0.2, 0.5, resolution=60), np.array([-0.7, 0.9, 0.95])),
        ]
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        for number, (mesh, place) in enumerate(pieces):
            outside = np.array([0.0, 0.0, -10.0]) if number in without else 0.0
            self._scene.add_triangles(mesh.translate(place + outside))
        rng = np.random.Generator(np.random.PCG64(11))  # the same room under `--spread` too
        self._base = rng.uniform(0.35, 0.75, (len(pieces), 3))
        # Values at the corners of a periodic lattice, for each of the textures' two cell sizes.
        grey, colour = rng.uniform(-1.0, 1.0, (2, 32, 32, 32, 1)), rng.uniform(-1.0, 1.0, (2, 32, 32, 32, 3))
        self._lattice = contrast * (0.8 * grey + 0.2 * colour)

    def cast(
        self, eye: NDArray[np.float64], rays: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
        """Cast rays and return parameter t (N,), index of the object (N,) and normal (N, 3) of each hit.

        Args:
            eye: (3,) origin of all rays.
            rays: (N, 3) directions.
        """
        six = np.concatenate([np.broadcast_to(eye, rays.shape), rays], axis=1).astype(np.float32)
        hit = self._scene.cast_rays(self._tensor(six), nthreads=1)
        return (
            hit["t_hit"].numpy().astype(np.float64),
            hit["geometry_ids"].numpy().astype(np.int64),
            hit["primitive_normals"].numpy().astype(np.float64),
        )

    def distance(self, xyz: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the distance (N,) of points (N, 3) from the nearest surface."""
        return self._scene.compute_distance(self._tensor(xyz.astype(np.float32)), nthreads=1).numpy()

    def depth(
        self, camera: PinholeCamera, T_camera_world: NDArray[np.float64], pixels: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the z-depth (N,) at pixels (N, 2)."""
        rays = camera.unproject(pixels, np.ones(len(pixels))) @ T_camera_world[:3, :3]
        return self.cast(inverse_se3(T_camera_world)[:3, 3], rays)[0]

    def image(self, camera: PinholeCamera, T_camera_world: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return an RGB image (H, W, 3) with four rays per pixel."""
        fine = pinhole(2 * camera.width, 2 * camera.height)
        x, y = np.meshgrid(np.arange(fine.width) + 0.5, np.arange(fine.height) + 0.5)
        pixels = np.stack([x.ravel(), y.ravel()], axis=1)
        rays = fine.unproject(pixels, np.ones(len(pixels))) @ T_camera_world[:3, :3]
        colour = self.colours(inverse_se3(T_camera_world)[:3, 3], rays)
        colour = colour.reshape(camera.height, 2, camera.width, 2, 3).mean(axis=(1, 3))
        return np.rint(255 * np.clip(colour, 0, 1)).astype(np.uint8)

    def colours(self, eye: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the colours (N, 3) that rays (N, 3) from `eye` see, about 0 to 1."""
        return self.shaded(eye, rays)[0]

    def shaded(
        self, eye: NDArray[np.float64], rays: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the colours (N, 3) of rays (N, 3) from `eye`, and parameter (N,) and normal (N, 3) of their hits."""
        if len(rays) > CACHED:
            parts = [self.shaded(eye, rays[at : at + CACHED]) for at in range(0, len(rays), CACHED)]
            return tuple(map(np.concatenate, zip(*parts, strict=True)))
        t, which, normal = self.cast(eye, rays)
        colour = self._base[which] + 0.28 * self._texture(eye + t[:, None] * rays + 7.3 * which[:, None])
        return colour * (0.75 + 0.25 * np.abs(normal @ LIGHT))[:, None], t, normal

    def _texture(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return smooth noise (N, 3) at points (N, 3), interpolated from lattice values."""
        found = np.zeros((len(xyz), 3))
        for lattice, cell in zip(self._lattice, CELLS, strict=True):
            low = np.floor(xyz / cell).astype(np.int64)
            share = xyz / cell - low
            share = np.ascontiguousarray((share * share * (3 - 2 * share)).T)
            weights, places = (1 - share, share), (low.T & 31, (low.T + 1) & 31)
            values = lattice.reshape(-1, 3)
            for x, y, z in np.ndindex(2, 2, 2):
                weight = weights[x][0] * weights[y][1] * weights[z][2]
                place = (places[x][0] * 32 + places[y][1]) * 32 + places[z][2]
                found += weight[:, None] * values.take(place, axis=0)
        return found


@dataclass(frozen=True)
class RoomRecording:
    """A walk through the room: images, and the poses and points of a simulated tracker.

    The tracked points have random errors of 0.3 px in the image and 2 % in depth (standard deviations).

    Attributes:
        room: The room.
        camera: The camera of all frames.
        T_camera_world: True pose (4, 4) of each frame.
        points: Twice the number of points that are sampled in each of `views` evenly spaced frames.
        views: Number of these frames.
        seed: Seed of the points and their errors.
    """

    room: Room
    camera: PinholeCamera
    T_camera_world: list[NDArray[np.float64]]
    points: int = 160
    views: int = 4
    seed: int = 0

    @cached_property
    def images(self) -> list[NDArray[np.uint8]]:
        return [self.room.image(self.camera, T) for T in self.T_camera_world]

    @cached_property
    def observations(self) -> tuple[NDArray[np.float64], list[NDArray[np.int64]], list[NDArray[np.float64]]]:
        """Points xyz (P, 3), and for each frame the indices (S,) of the points that it sees and their pixels (S, 2)."""
        rng = np.random.default_rng(self.seed)
        size = [self.camera.width, self.camera.height]
        found = []
        for T in self.T_camera_world[:: max(len(self.T_camera_world) // self.views, 1)]:
            pixels = rng.uniform([2, 2], np.array(size) - 2, (self.points // 2, 2))
            z = self.room.depth(self.camera, T, pixels)
            found.append((self.camera.unproject(pixels, z) - T[:3, 3]) @ T[:3, :3])
        true = np.concatenate(found)
        seen, places = [], []
        for T in self.T_camera_world:
            local = true @ T[:3, :3].T + T[:3, 3]
            ahead = np.flatnonzero(local[:, 2] > 0.1)
            pixels = self.camera.project(local[ahead])
            inside = ((pixels > 1) & (pixels < np.array(size) - 1)).all(axis=1)
            ahead, pixels = ahead[inside], pixels[inside]
            visible = self.room.depth(self.camera, T, pixels) > 0.98 * local[ahead, 2]
            seen.append(ahead[visible])
            places.append(pixels[visible] + rng.normal(0, 0.3, (visible.sum(), 2)))
        eye = inverse_se3(self.T_camera_world[0])[:3, 3]
        return true + 0.02 * rng.normal(size=(len(true), 1)) * (true - eye), seen, places

    def frames(self) -> list[TrackedFrame]:
        """Return the recording as tracked frames at ten frames per second."""
        xyz, seen, pixels = self.observations
        return [
            TrackedFrame(i, i / 10, f"{i:04d}", (image / 255).astype(np.float32), self.camera, T, points)
            for i, (image, T, points) in enumerate(
                zip(
                    self.images,
                    self.T_camera_world,
                    (SparsePoints(xyz[ids], uv, ids) for ids, uv in zip(seen, pixels, strict=True)),
                    strict=True,
                )
            )
        ]

    def write(self, folder: Path, gains: NDArray[np.float64] | None = None) -> None:
        """Write the recording to a folder.

        Args:
            folder: Gets the images as `images/NNNN.png` and a COLMAP model in `sparse/0`.
            gains: (F,) factors on the images' brightness, None for 1.
        """
        (folder / "images").mkdir(parents=True)
        names = [f"{i:04d}.png" for i in range(len(self.T_camera_world))]
        gains = np.ones(len(names)) if gains is None else gains
        for name, image, gain in zip(names, self.images, gains, strict=True):
            cv2.imwrite(str(folder / "images" / name), np.clip(gain * image[..., ::-1], 0, 255).astype(np.uint8))
        (folder / "sparse" / "0").mkdir(parents=True)
        write_colmap(folder / "sparse" / "0", self.camera, names, self.T_camera_world, *self.observations)


def write_colmap(
    folder: Path,
    camera: PinholeCamera,
    names: list[str],
    T_camera_world: list[NDArray[np.float64]],
    xyz: NDArray[np.float64],
    seen: list[NDArray[np.int64]],
    pixels: list[NDArray[np.float64]],
    text: bool = False,
) -> None:
    """Write a COLMAP model of posed images.

    Args:
        folder: An existing folder.
        camera: The camera of all images.
        names: Names of the images.
        T_camera_world: Pose (4, 4) of each image.
        xyz: (P, 3) points.
        seen: Indices (S,) of the points that each image sees.
        pixels: Pixels (S, 2) of these points.
        text: Write the text format instead of the binary one.
    """
    model = pycolmap.Reconstruction()
    parameters = [camera.fx, camera.fy, camera.cx, camera.cy]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=camera.width, height=camera.height, params=parameters)
    )
    tracks = [pycolmap.Track() for _ in xyz]
    for i, (name, T) in enumerate(zip(names, T_camera_world, strict=True)):
        places = pycolmap.Point2DList([pycolmap.Point2D(uv) for uv in pixels[i]])
        image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1, points2D=places)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(T[:3]))
        for place, j in enumerate(seen[i]):
            tracks[j].add_element(i + 1, place)
    for place, track in zip(xyz, tracks, strict=True):
        model.add_point3D(place, track)
    model.write_text(str(folder)) if text else model.write_binary(str(folder))

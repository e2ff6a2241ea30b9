"""Merging of the maps of a recording's parts: one gauge of colour, an owner of each place, one map.

What floats in free space is left out. Only its own keyframes hold the map of a part: next to what they see, large
Gaussians with a wrong depth remain. In the keyframes of another part, they hang before the surface like fog.
"""
# pyright: reportArgumentType=false, reportCallIssue=false, reportInvalidTypeForm=false, reportOptionalSubscript=false

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.gaussians import SH_C0
from fields.runtime.engine import ti
from pipelines.online import OnlineMapper
from pipelines.render.formulas import IDENTITY
from pipelines.render.renderer import Renderer
from pipelines.whole.finished_map import FinishedMap, take_in_frames, take_in_gaussians

# A Gaussian is before a surface if its depth is less than this share of the surface's.
BEFORE = 0.85
# Least opacity of a pixel with a surface.
LEAST_OPACITY = 0.5


@dataclass(frozen=True)
class ShownSurface:
    """The surface that a map shows in one of its own keyframes.

    Attributes:
        number: Number of the map.
        camera: The keyframe's camera.
        T_camera_world: (4, 4) pose.
        depth: (H, W) z of the surface, 0 where there is none.
    """

    number: int
    camera: PinholeCamera
    T_camera_world: NDArray[np.float64]
    depth: NDArray[np.floating]


@ti.data_oriented
class FreeSpace:
    """Finds the Gaussians that show more before the surfaces of other maps than anywhere else.

    How much a Gaussian shows in a view is the sum of its compositing weights alpha T over the pixels with a surface.
    The sum of alpha T / D, where D is the depth of the surface, then tells the mean inverse depth of the surface where
    the Gaussian is. Both are derivatives of weighted sums of the picture's colours by the Gaussian's colour, and come
    from one backward pass of compositing.
    """

    def __init__(self, renderer: Renderer, near: float) -> None:
        self.renderer = renderer
        self.projected = renderer.projected
        self._near = near

    def surface(self, number: int, camera: PinholeCamera, T_camera_world: NDArray[np.float64]) -> ShownSurface:
        """Return what the map with this number shows in a keyframe, which must be the last rendered view."""
        depth = self.renderer.rendered().expected_depth(LEAST_OPACITY)
        return ShownSurface(number, camera, T_camera_world, depth.astype(np.float32))

    def floating(self, numbers: NDArray[np.integer], views: Sequence[ShownSurface]) -> NDArray[np.bool_]:
        """Return which of the loaded Gaussians (N,), of maps of these numbers, float before surfaces of other maps."""
        before, elsewhere = np.zeros(len(numbers)), np.zeros(len(numbers))
        for view in views:
            has_surface = view.depth > 0
            inverse = np.where(has_surface, 1.0 / np.where(has_surface, view.depth, 1.0), 0.0)
            index, z, (weight, weighted_inverse) = self.shown(view.camera, view.T_camera_world, has_surface, inverse)
            is_before = (z * weighted_inverse < BEFORE * weight) & (numbers[index] != view.number)
            before[index] += np.where(is_before, weight, 0.0)
            elsewhere[index] += np.where(is_before, 0.0, weight)
        return before > elsewhere

    def shown(
        self, camera: PinholeCamera, T_camera_world: NDArray[np.float64], *channels: NDArray
    ) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
        """Render the loaded Gaussians, and sum values of pixels by how much each Gaussian shows in them.

        Args:
            camera: The camera.
            T_camera_world: (4, 4) pose.
            *channels: One to three images (H, W) of values.

        Returns:
            Indices (M,) of the Gaussians in the image, their depths z (M,), and the sums (C, M) of alpha T times value.
        """
        renderer = self.renderer
        renderer.forward(camera, T_camera_world, self._near)
        none = np.zeros_like(channels[0], dtype=np.float32)
        colour = np.stack([*channels, *[none] * (3 - len(channels))], axis=-1)
        renderer.images.set_gradients(colour, none, none)
        renderer.compositing.backward()
        renderer.view_renders += 1
        count = self.projected.seen[None]
        index, values = np.empty(count, dtype=np.int32), np.empty((count, 4), dtype=np.float32)
        if count:
            self._read(index, values)
        return index, values[:, 3], values.T[: len(channels)]

    @ti.kernel
    def _read(self, index: ti.types.ndarray(dtype=ti.i32, ndim=1), values: ti.types.ndarray(dtype=ti.f32, ndim=2)):
        for s in range(index.shape[0]):
            index[s] = self.projected.gaussian[s]
            for c in ti.static(range(3)):
                values[s, c] = ti.cast(self.projected.colour.grad[s][c], ti.f32)
            values[s, 3] = ti.cast(self.projected.depth[s], ti.f32)


Exposures = Mapping[int, NDArray[np.float64]]


def colour_changes(maps: Sequence[Exposures]) -> list[NDArray[np.float64]]:
    """Return the transforms (3, 4) of the colours of each map to those of the first one, given exposures by frame.

    Each map is compared with the one before it, in the frames that both have an exposure of; it takes over the
    transform of that one if there are none.
    """
    changes = [np.array(IDENTITY)]
    for before, here in pairwise(maps):
        found = [_after(_inverse(before[i]), here[i]) for i in sorted(set(before) & set(here))]
        change = np.mean(found, axis=0) if found else np.array(IDENTITY)
        changes.append(_after(changes[-1], change))
    return changes


def recoloured(sh: NDArray[np.floating], change: NDArray[np.float64]) -> NDArray[np.floating]:
    """Return the coefficients (N, K, 3) of colours after a transform (3, 4) of these colours."""
    changed = sh.astype(np.float64) @ change[:, :3].T
    changed[:, 0] += (change[:, :3].sum(axis=1) * 0.5 + change[:, 3] - 0.5) / SH_C0
    return changed.astype(sh.dtype)


def exposed_in(exposure: NDArray[np.float64], change: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the exposure (3, 4) with which a frame's image stays the same when the colours are transformed (3, 4)."""
    return _after(exposure, _inverse(change))


def _after(second: NDArray[np.float64], first: NDArray[np.float64]) -> NDArray[np.float64]:
    """The transform (3, 4) that applies `first`, and then `second`."""
    return np.column_stack([second[:, :3] @ first[:, :3], second[:, :3] @ first[:, 3] + second[:, 3]])


def _inverse(transform: NDArray[np.float64]) -> NDArray[np.float64]:
    A = np.asarray(np.linalg.inv(transform[:, :3]), dtype=np.float64)
    return np.column_stack([A, -A @ transform[:, 3]])


NEIGHBOURS = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
# Cubes farther from the origin than this are taken as one. Three such coordinates fit into 63 bits.
FARTHEST = (1 << 20) - 2


@dataclass(frozen=True)
class Shown:
    """How the own keyframes of a map show its Gaussians.

    Attributes:
        position: Positions (N, 3) in the world frame.
        coverage: Pixels (N,) that each covers where it shows most, see `Contribution`.
    """

    position: NDArray[np.floating]
    coverage: NDArray[np.floating]


def owned(maps: Sequence[Shown], edge: float) -> list[NDArray[np.bool_]]:
    """Return which Gaussians (N,) of each map lie in a cube, of so long an edge, of that map.

    Gaussians that do not show are not kept. Of equal scores, that of the first map counts.
    """
    cubes = [_cubes(each.position, edge) for each in maps]
    keys, places = np.unique(_keys(np.concatenate(cubes)), return_inverse=True)
    at = np.split(places.reshape(-1), np.cumsum([len(each) for each in cubes])[:-1])
    owner, best = np.full(len(keys), -1), np.zeros(len(keys))
    for number, each in enumerate(maps):
        score = np.bincount(at[number], each.coverage, len(keys)).astype(np.float64)
        around = _around(keys, score)
        wins = (score > 0.0) & (around > best)
        owner[wins], best[wins] = number, around[wins]
    return [(owner[at[number]] == number) & (each.coverage > 0.0) for number, each in enumerate(maps)]


def _cubes(position: NDArray[np.floating], edge: float) -> NDArray[np.int64]:
    """Return the integer coordinates (N, 3) of the cubes of positions."""
    return np.floor(np.clip(position / edge, -FARTHEST, FARTHEST)).astype(np.int64)


def _keys(cubes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one number (N,) for each cube. Those of two cubes differ by a sum over their coordinates."""
    return cubes @ np.array([1 << 42, 1 << 21, 1])


def _around(keys: NDArray[np.int64], score: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sum (M,) of the scores of each cube and its neighbours, of those that are among the sorted `keys`."""
    total = np.zeros(len(keys))
    for step in _keys(NEIGHBOURS):
        there = np.minimum(np.searchsorted(keys, keys + step), len(keys) - 1)
        total += np.where(keys[there] == keys + step, score[there], 0.0)
    return total


# Edge of the cubes in which the maps compete for space [scene depths].
EDGE = 1 / 16
# Pyramid level at which it is measured how much of each Gaussian shows, which takes half as long as at the full size.
COARSE = 1
# How often Gaussians that float in free space are looked for. What they hid, and what the next owner of their place has
# there, may float as well: 654 and 148 Gaussians of four parts with 79,497. A third time finds 23.
ROUNDS = 2


@dataclass(frozen=True)
class MappedPart:
    """What the run of a part keeps of its map. Frames are named by their indices in the whole recording.

    Attributes:
        own: The frames that belong to this part. Its other frames belong to the parts before and after it.
        gaussians: The Gaussians, as from `GaussianField.to_numpy`.
        keyframes: The keyframes.
        poses: Refined T_camera_world (4, 4) of each frame.
        exposures: Exposure (3, 4) of each frame; empty if none was estimated.
        scene_depth: Depth of keyframes without tracked points [scene units].
        view_renders: Number of views that were rendered and differentiated to make the map.
    """

    own: range
    gaussians: Mapping[str, NDArray]
    keyframes: Sequence[int]
    poses: Mapping[int, NDArray[np.float64]]
    exposures: Mapping[int, NDArray[np.float64]]
    scene_depth: float
    view_renders: int


def merge(mapper: OnlineMapper, parts: Sequence[MappedPart], frames: Iterable[TrackedFrame]) -> list[int]:
    """Put the maps of the parts of a recording into a new online map.

    Every frame has the pose and the exposure that the part has found that it belongs to, and every Gaussian comes from
    the part that owns its place, see `pipelines.whole.merge`. What floats where another part sees free space is
    left out, see `pipelines.whole.merge`.

    Args:
        mapper: The new map, without frames.
        parts: The parts, in order. Each frame belongs to one of them.
        frames: All frames of the recording in order, with their tracked poses. They are iterated over once.

    Returns:
        The number of Gaussians that are left of each part.

    Raises:
        ValueError: If the Gaussians do not fit the settings, or none of the keyframes is among the frames.
    """
    parts = _in_one_gauge(parts)
    mapper.renderer.view_renders += sum(part.view_renders for part in parts)
    take_in_frames(mapper, _finished(parts, frames))
    kept = _kept(mapper, parts)
    take_in_gaussians(mapper, _together(parts, kept))
    return [int(own.sum()) for own in kept]


def _kept(mapper: OnlineMapper, parts: Sequence[MappedPart]) -> list[NDArray[np.bool_]]:
    """Return which Gaussians (N,) of each part are kept: what it owns, and no keyframe of another part sees through."""
    space, contribution = FreeSpace(mapper.renderer, mapper.near), mapper.hidden.contribution
    shown: list[Shown] = []
    views: list[ShownSurface] = []
    for number, part in enumerate(parts):
        mapper.gaussians.load(dict(part.gaussians))
        contribution.begin()
        for view in mapper.keyframes:
            if view.index in part.own:
                contribution.measure([view], mapper.near, COARSE)
                views.append(space.surface(number, view.image(COARSE).camera, view.T_camera_world))
        shown.append(Shown(part.gaussians["position"].astype(np.float64), mapper.gaussians.coverages()))
    numbers = np.repeat(np.arange(len(parts)), [len(each.position) for each in shown])
    ends = np.cumsum([len(each.position) for each in shown])[:-1]
    floating = np.zeros(len(numbers), dtype=np.bool_)
    for _ in range(ROUNDS):
        kept = owned(shown, EDGE * mapper.keyframes.scene_depth)
        mapper.gaussians.load(_together(parts, kept))
        places = np.flatnonzero(np.concatenate(kept))
        floating[places] = space.floating(numbers[places], views)
        shown = [
            replace(each, coverage=np.where(floats, 0.0, each.coverage))
            for each, floats in zip(shown, np.split(floating, ends), strict=True)
        ]
    return owned(shown, EDGE * mapper.keyframes.scene_depth)


def _together(parts: Sequence[MappedPart], kept: Sequence[NDArray[np.bool_]]) -> dict[str, NDArray]:
    """Return the Gaussians that are kept of all parts."""
    return {
        name: np.concatenate([part.gaussians[name][own] for part, own in zip(parts, kept, strict=True)])
        for name in parts[0].gaussians
    }


def _finished(parts: Sequence[MappedPart], frames: Iterable[TrackedFrame]) -> FinishedMap:
    """Return the merged map without Gaussians: what each part knows of its own frames."""
    return FinishedMap(
        {},
        frames,
        {index for part in parts for index in part.keyframes if index in part.own},
        {index: part.exposures[index] for part in parts for index in part.own if index in part.exposures},
        float(np.median([part.scene_depth for part in parts])),
        {index: part.poses[index] for part in parts for index in part.own},
    )


def _in_one_gauge(parts: Sequence[MappedPart]) -> list[MappedPart]:
    """Return the parts with the colours of the first one. Without any exposures, they stay as they are."""
    if not any(part.exposures for part in parts):
        return list(parts)
    exposures = [{i: part.exposures.get(i, np.array(IDENTITY)) for i in part.poses} for part in parts]
    return [
        replace(
            part,
            gaussians={**part.gaussians, "sh": recoloured(part.gaussians["sh"], change)},
            exposures={i: exposed_in(exposure, change) for i, exposure in own.items()},
        )
        for part, own, change in zip(parts, exposures, colour_changes(exposures), strict=True)
    ]

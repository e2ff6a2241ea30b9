"""The direction of down in a finished map, by gravity if the video has it, else by the vertical edges in its views.

A straight edge and the camera's centre span a plane. The normals of these planes, for all edges of one direction, are
orthogonal to it, in all views together. On the demo, this finds the vertical to 0.04 degrees; normals of the map's
depth, which follow every unevenness of it, miss it by 2 degrees and more. Gravity goes first, since it does not depend
on the lens: with the estimated lens of a GoPro's video, edges are 4 degrees off, though they agree to 0.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.positions import recorded_gravity
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.map_renderer import MapRenderer, start_device
from modp_ti.outputs.playback.run_frames import run_settings
from modp_ti.outputs.progress import ProgressLine
from modp_ti.outputs.splat_page.page import level, levelled

# Most views that are rendered, evenly spaced, and their longest side [px].
VIEWS, LONGEST = 64, 1280
# Shortest edge [longer sides] and [px], and what OpenCV's coordinates of edges lack to ours [px]: half a pixel of its
# scale of 0.8. Shorter ones are straight by chance, and have the directions of the picture's axes.
SHORTEST, FEWEST_PIXELS, OFFSET = 0.04, 16.0, 0.625
# The vertical is looked for so near what the cameras tell, among so many directions on which two edges agree.
CONE, CANDIDATES = np.radians(30.0), 3000
# Deviation of an edge from the vertical: for the choice among the directions, and for their refinement.
WIDE, NARROW, STEPS = np.radians(1.5), np.radians(0.7), 10
# Share of the edges that must be vertical: twice what it is by chance.
LEAST = 0.03
# Parts of the recording that are left out in turn, for the deviation.
PARTS = 8


@dataclass(frozen=True)
class Vertical:
    """The direction of down.

    Attributes:
        down: Unit vector (3,).
        deviation: Its standard deviation [rad], without that of the lens.
        by: What it was measured by.
    """

    down: NDArray[np.float64]
    deviation: float
    by: str


def vertical(run: FinishedRun, line: ProgressLine) -> Vertical | None:
    """Return the direction of down in a finished map; None if neither gravity nor enough vertical edges are known."""
    held, path = levelled(run).R[1], run_settings(run).source.path
    if (found := by_gravity(path, run.timestamps, run.poses)) is not None:
        return found
    start_device("auto")
    shots = [(run.cameras[place].within(LONGEST), run.poses[place]) for place in run.spread(VIEWS)]
    renderer = MapRenderer(run.gaussians, LONGEST, LONGEST, run.record.near)
    views = line.through("looking for vertical edges", shots, len(shots))
    found = common_direction([edges(renderer.picture(*shot), *shot) for shot in views], held)
    return None if found is None else Vertical(*found, "vertical edges")


def by_gravity(path: Path | None, times: NDArray[np.float64], poses: NDArray[np.float64]) -> Vertical | None:
    """Return the direction of down by the gravity that a recording holds; None if it holds none.

    Args:
        path: The recording, None for a live one.
        times: Times of its frames (F,) [s].
        poses: Their T_camera_world (F, 4, 4).

    Raises:
        InputError: If the recording is damaged.
    """
    gravity = None if path is None else recorded_gravity(path, times)
    found = None if gravity is None else mean_direction(poses, gravity, level(poses, 1.0).R[1])
    return None if found is None else Vertical(*found, "gravity")


def mean_direction(
    poses: NDArray[np.float64], directions: NDArray[np.float64], around: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float] | None:
    """Return the mean (3,) of directions in cameras (F, 3), given T_camera_world (F, 4, 4), and its deviation [rad].

    The deviation is from how the means of the recording's parts differ. None if they are not around a unit vector (3,):
    such a picture was turned after it was taken.
    """
    there = np.einsum("nij,ni->nj", poses[:, :3, :3], directions)
    mean = there.mean(axis=0) / np.linalg.norm(there.mean(axis=0))
    parts = np.stack([part.mean(axis=0) for part in np.array_split(there, PARTS) if len(part)])
    spread = float(np.sqrt(((parts - parts.mean(axis=0)) ** 2).sum() / max(len(parts) - 1, 1) / len(parts)))
    return (mean, spread) if (there @ around > np.cos(CONE)).all() else None


def edges(
    picture: NDArray[np.uint8], camera: PinholeCamera, T_camera_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the straight edges (N, 4) of a picture (H, W, 3): unit normal in the world of its plane, length [px]."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    ends = np.zeros((0, 2, 2)) if found is None else found.reshape(-1, 2, 2) + OFFSET
    length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    ends, length = (
        part[length > max(SHORTEST * max(camera.width, camera.height), FEWEST_PIXELS)] for part in (ends, length)
    )
    start, end = (camera.unproject(ends[:, side], np.ones(len(ends))) @ T_camera_world[:3, :3] for side in (0, 1))
    normal = np.cross(start, end).astype(np.float64)
    return np.column_stack([normal / np.linalg.norm(normal, axis=1, keepdims=True), length]).astype(np.float64)


def common_direction(
    views: Sequence[NDArray[np.float64]], around: NDArray[np.float64], seed: int = 0
) -> tuple[NDArray[np.float64], float] | None:
    """Find the direction near a given one that most edges have.

    Args:
        views: Edges (N, 4) of each view, in the order of the recording, as from `edges`.
        around: Unit vector (3,), `CONE` from it at most.
        seed: Seed of the draws.

    Returns:
        The direction (3,), and its standard deviation [rad] from what it changes by without a part of the views. None
        if there are not clearly more such edges than by chance.
    """
    part = np.repeat(np.arange(len(views)) * PARTS // max(len(views), 1), [len(view) for view in views])
    normals, length = (lines := np.concatenate(views))[:, :3], lines[:, 3]
    if len(lines) < 2:
        return None
    pairs = np.random.default_rng(seed).choice(len(lines), (2, CANDIDATES), p=length / length.sum())
    found = np.cross(normals[pairs[0]], normals[pairs[1]])
    found = found[(size := np.linalg.norm(found, axis=1)) > 0.1] / size[size > 0.1, None]
    found = found * np.sign(found @ around)[:, None]
    found = found[found @ around > np.cos(CONE)]
    if len(found) == 0:
        return None
    best = max(found, key=lambda direction: float(length @ _likely(normals @ direction, WIDE)))
    down, share = _refined(normals, length, best)
    others = [_refined(normals[part != k], length[part != k], down)[0] for k in np.unique(part)]
    spread = float(np.sqrt((len(others) - 1) / len(others) * np.sum((np.array(others) - np.mean(others, axis=0)) ** 2)))
    return (down, spread) if share > LEAST else None


def _refined(
    normals: NDArray[np.float64], length: NDArray[np.float64], direction: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Return the direction (3,) most orthogonal to normals (N, 3) of those near it, and the share that these are."""
    weight = length
    for _ in range(STEPS):
        weight = length * _likely(normals @ direction, NARROW)
        found = np.linalg.eigh((normals * weight[:, None]).T @ normals)[1][:, 0]
        direction = found * np.sign(found @ direction)
    return direction, float(weight.sum() / length.sum()) if len(length) else 0.0


def _likely(sine: NDArray[np.float64], deviation: float) -> NDArray[np.float64]:
    return np.exp(-0.5 * (sine / deviation) ** 2)

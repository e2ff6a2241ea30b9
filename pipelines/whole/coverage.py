"""Coverage: from how wide an angle keyframes see the places of a map, which decides how sharp they are from elsewhere.

In a furnished room, unseen views have 25 dB where the widest angle between two keyframes' rays is below a degree, 28 dB
at 3 to 6 degrees, and 31 to 33 dB from 12 degrees on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import camera_centres
from pipelines.render.renderer import RenderedView

# Widest angle below which a place is thin [degrees].
THIN = 6.0
# Longer side of a kept depth image [px]; and the relative difference within which a depth is that of the place.
SIDE = 96
SAME_SURFACE = 0.1
# Thin places that are asked for where to film from.
ASKED = 4000


@dataclass(frozen=True)
class SeenDepth:
    """What a camera sees, coarsely.

    Attributes:
        T_camera_world: Pose (4, 4).
        camera: The camera, for pictures of `SIDE` pixels.
        depth: Rendered depth (h, w) float32, 0 where nothing is.
    """

    T_camera_world: NDArray[np.float64]
    camera: PinholeCamera
    depth: NDArray[np.float32]

    @classmethod
    def of(cls, T_camera_world: NDArray[np.float64], camera: PinholeCamera, view: RenderedView) -> SeenDepth:
        """Keep what is needed of the render of a view, of any size."""
        small = camera.within(SIDE)
        depth = view.expected_depth().astype(np.float32)
        depth = cv2.resize(depth, (small.width, small.height), interpolation=cv2.INTER_NEAREST)
        return cls(np.array(T_camera_world), small, np.asarray(depth, dtype=np.float32))

    @property
    def centre(self) -> NDArray[np.float64]:
        """Centre (3,) of the camera."""
        return camera_centres(self.T_camera_world[None])[0]

    def sees(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the indices of the points (N, 3) that lie on a surface in the image."""
        there = points @ self.T_camera_world[:3, :3].T + self.T_camera_world[:3, 3]
        ahead = np.flatnonzero(there[:, 2] > 0)
        pixels = self.camera.project(there[ahead])
        inside = self.camera.contains(pixels)
        ahead, z = ahead[inside], there[ahead[inside], 2]
        x, y = pixels[inside].astype(np.int64).T
        return ahead[np.abs(self.depth[y, x] - z) < SAME_SURFACE * z]


def widest_angles(points: NDArray[np.float64], seen: Sequence[SeenDepth], scene_depth: float) -> NDArray[np.float64]:
    """Return from how wide an angle points (N, 3) are seen (N,) [degrees]; NaN where no camera sees them.

    It is the largest angle between the ray of the first camera that sees a point and those of all others. An angle
    counts for more on a far point, as cameras move by less than the scene's depth.

    Args:
        points: The points.
        seen: What the cameras see.
        scene_depth: Depth of the scene [scene units].
    """
    first, nearest = np.full((len(points), 3), np.nan), np.full(len(points), np.inf)
    cosine = np.ones(len(points))
    for view in seen:
        there = view.sees(points)
        rays = points[there] - view.centre
        distance = np.linalg.norm(rays, axis=1)
        rays /= distance[:, None]
        nearest[there] = np.minimum(nearest[there], distance)
        fresh = np.isnan(first[there, 0])
        first[there[fresh]] = rays[fresh]
        cosine[there] = np.minimum(cosine[there], (rays * first[there]).sum(axis=1))
    nearest[np.isinf(nearest)] = np.nan
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))) * np.maximum(nearest / scene_depth, 1.0)


def where_to_film(
    points: NDArray[np.float64], angles: NDArray[np.float64], seen: Sequence[SeenDepth]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return where to stand (3,) and what to look at (3,), so that the most thin points are seen from a wider angle.

    The place lies to the side of the camera that sees the most of them, away from all other cameras, so that both
    rays differ by twice `THIN`. None if nothing is thin.

    Args:
        points: Points (N, 3).
        angles: Their angles (N,) from `widest_angles`.
        seen: What the cameras see.
    """
    thin = points[angles < THIN]
    thin = thin[:: -(-len(thin) // ASKED) or 1]
    in_sight = [view.sees(thin) for view in seen]
    most = int(np.argmax([len(each) for each in in_sight])) if seen else 0
    if not seen or len(in_sight[most]) == 0:
        return None
    view, target = seen[most], np.median(thin[in_sight[most]], axis=0)
    ahead = target - view.centre
    side = np.cross(ahead, view.T_camera_world[1, :3])
    side *= np.linalg.norm(ahead) * np.tan(np.radians(2 * THIN)) / max(float(np.linalg.norm(side)), 1e-12)
    centres = np.stack([each.centre for each in seen])
    places = [view.centre + side, view.centre - side]
    apart = [np.linalg.norm(centres - place, axis=1).min() for place in places]
    return places[int(np.argmax(apart))], target

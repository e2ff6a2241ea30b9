"""`RoomRenderer`: bakes the light of the room once, then renders any view of it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.synthetic import raytracer
from modp_ti.inputs.synthetic.room import EXPOSURE, LIT_LOWER, LIT_UPPER, SUN, build_room
from modp_ti.inputs.synthetic.scene import SceneArrays

__all__ = ["LIGHT_TEXEL", "RoomRenderer", "bake_light"]

LIGHT_TEXEL = 0.06  # [m]
SHADOW_SIDE = 4  # 16 shadow rays to each light
GATHER_SIDES = (
    4,
    7,
)  # of each bounce: 16, then 49 rays over the hemisphere; only the last one is seen directly
GATHER_WIDTH = 0.3  # such few rays see a blurred world

# The centre, then four positions on a rotated grid: each row and column of a 5x5 raster of the pixel has one.
SAMPLES = ((0.5, 0.5), (0.3, 0.1), (0.9, 0.3), (0.1, 0.7), (0.7, 0.9))
BRIGHTEST = 4.0  # a sample counts at most this much, lest one in five frays an edge before the sky


class RoomRenderer:
    """The demo room. Taichi must be initialised; one instance serves any number of views and sizes.

    texel: edge of a light-map cell in metres; coarser is quicker and blurs the shadows.
    """

    def __init__(self, texel: float = LIGHT_TEXEL) -> None:
        self.arrays = build_room().arrays(texel)
        self._light = bake_light(self.arrays, SUN)

    def render(
        self, camera: PinholeCamera, T_camera_world: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Image (H, W, 3) float32 RGB in [0, 1], and depth (H, W) float32.

        Depth is z in the camera frame at the pixel centres, in metres.
        """
        shape = camera.height, camera.width
        rotation = T_camera_world[:3, :3].T
        centre = (-rotation @ T_camera_world[:3, 3]).astype(np.float32).reshape(1, 3)
        width = float(0.5 / camera.focal)  # of a sample; there are two across a pixel
        directions = np.empty((*shape, 3), np.float32)
        exposed = np.zeros((*shape, 3), np.float32)
        depth = np.zeros(shape, np.float32)
        for k, offset in enumerate(SAMPLES):
            raytracer.camera_rays(rotation, [camera.fx, camera.fy], [camera.cx, camera.cy], list(offset), directions)
            rays = directions.reshape(-1, 3)
            colour, distance = _radiance(self.arrays, self._light, SUN, centre, rays, width, seen=True)
            exposed += np.minimum(EXPOSURE * colour, BRIGHTEST).reshape(exposed.shape)
            if k == 0:
                forward = T_camera_world[2, :3].astype(np.float32)
                depth = (distance * (rays @ forward)).reshape(shape)
        return _developed(exposed / len(SAMPLES)), depth


def bake_light(arrays: SceneArrays, sun: NDArray[np.float32]) -> NDArray[np.float32]:
    """Light map (N, 3): what a white surface shows under the area lights and what other surfaces reflect.

    Direct sunlight has sharp edges and is left to the frames; reflected once, it is in the map.
    """
    a = arrays
    count = len(a.texel_owner)
    places = np.zeros(count, np.int32)
    raytracer.find_open_places(a.primitives, a.nodes, a.patches, a.texel_owner, LIT_LOWER, LIT_UPPER, places)
    direct = np.zeros((count, 3), np.float32)
    raytracer.bake_direct(a.primitives, a.nodes, a.patches, a.texel_owner, places, a.lights, SHADOW_SIDE, direct)
    direct = _smoothed(a, direct, places >= 0, 0.7)
    light = direct
    origins, directions = np.zeros_like(direct), np.zeros_like(direct)
    for side in GATHER_SIDES:
        gathered = np.zeros_like(direct)
        for sample in range(side * side):
            raytracer.gather_rays(a.primitives, a.patches, a.texel_owner, places, side, sample, origins, directions)
            gathered += _radiance(a, light, sun, origins, directions, GATHER_WIDTH, seen=False)[0]
        light = direct + _smoothed(a, gathered / (side * side), places >= 0, 1.5)
    return light


def _radiance(
    arrays: SceneArrays,
    light: NDArray[np.float32],
    sun: NDArray[np.float32],
    origins: NDArray[np.float32],
    directions: NDArray[np.float32],
    width: float,
    seen: bool,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Linear colours (R, 3) and distances (R,) along rays; see `raytracer.radiance`."""
    a = arrays
    colour = np.empty((len(directions), 3), np.float32)
    distance = np.empty(len(directions), np.float32)
    tables = a.primitives, a.nodes, a.patches, a.texels, a.textures
    raytracer.radiance(*tables, light, sun, origins, directions, width, int(seen), colour, distance)
    return colour, distance


def _developed(exposed: NDArray[np.float32]) -> NDArray[np.float32]:
    """Exposed linear colour to display values in [0, 1]: a soft shoulder, then the sRGB curve."""
    y = np.minimum(exposed * (1 + exposed / 9) / (1 + 0.55 * exposed), 1)
    return np.where(y <= 0.0031308, 12.92 * y, 1.055 * y ** np.float32(1 / 2.4) - 0.055).astype(np.float32)


def _smoothed(
    arrays: SceneArrays, light: NDArray[np.float32], measured: NDArray[np.bool_], blur: float
) -> NDArray[np.float32]:
    """The light with its sampling noise blurred within each patch, by `blur` texels.

    Hidden texels take the light of the nearest measured ones: they would darken the edges of what hides them.
    """
    result = light.copy()
    for start, nu, nv, _ in arrays.patches[:, 3].astype(int):
        cells = slice(start, start + nu * nv)
        known = measured[cells].reshape(nv, nu).astype(np.float32)
        if not known.any():
            continue
        patch = light[cells].reshape(nv, nu, 3) * known[..., None]
        blurred, missing = np.zeros_like(patch), np.ones((nv, nu), bool)
        for sigma in (blur, 2 * blur, 5.0, 50.0):
            weight = cv2.GaussianBlur(known, (0, 0), sigma)
            total = cv2.GaussianBlur(patch, (0, 0), sigma)
            found = missing & (weight > 0.02)
            blurred[found] = total[found] / weight[found, None]
            missing &= ~found
            if not missing.any():
                break
        result[cells] = blurred.reshape(-1, 3)
    return result

"""What the page can show, as pictures of our own renderer from a browser's camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3, matrix_from_quaternion
from modp_ti.outputs.playback.film import depth_colours
from modp_ti.outputs.playback.map_renderer import eight_bits
from modp_ti.outputs.viewer.handover import BrowserCamera
from pipelines.render.renderer import RenderedView

__all__ = [
    "MODES",
    "SPLATS",
    "Photograph",
    "coloured_error",
    "error_picture",
    "image_error",
    "nearest_photograph",
    "picture_of",
    "pinhole_of",
]

# Splats are drawn by the browser; the others are pictures behind the scene.
SPLATS = "splats"
MODES = (SPLATS, "colour", "depth", "opacity", "error")
# Fields of view [rad] and canvases (width over height) of browsers that are not taken for a mistake.
FIELDS_OF_VIEW = (np.radians(1.0), np.radians(170.0))
ASPECTS = (0.1, 10.0)
LEAST_SIDE = 16
# Mean absolute difference of colours, in [0, 1], from which on an error is shown as the largest.
LARGEST_ERROR = 0.25
# What no photograph shows has no error.
UNSEEN = 40
# A surface counts as seen by a photograph where the map's depth there agrees within this share.
SAME_SURFACE = 0.05


@dataclass(frozen=True)
class Photograph:
    """A frame to compare the map with.

    rgba: (H, W, 4) uint8, 255 where it is valid. exposure: (3, 4), vignette: (H', W', 3) of any size, as in `Keyframe`;
    None where there is none.
    """

    rgba: NDArray[np.uint8]
    camera: PinholeCamera
    T_camera_world: NDArray[np.float64]
    exposure: NDArray[np.float64] | None = None
    vignette: NDArray[np.float32] | None = None


def pinhole_of(
    camera: BrowserCamera, units: float, max_width: int, max_height: int
) -> tuple[PinholeCamera, NDArray[np.float64]] | None:
    """The browser's camera as one of ours, with T_camera_world (4, 4): as large as fits, of its canvas's shape.

    units: of the page, in a unit of the world. None for what no browser can mean.
    """
    numbers = np.concatenate([camera.wxyz, camera.position, [camera.fov]])
    if not np.isfinite(numbers).all() or np.linalg.norm(camera.wxyz) < 1e-6:
        return None
    if min(camera.width, camera.height) < 1 or not FIELDS_OF_VIEW[0] <= camera.fov <= FIELDS_OF_VIEW[1]:
        return None
    aspect = camera.width / camera.height
    if not ASPECTS[0] <= aspect <= ASPECTS[1]:
        return None
    height = min(max_height, max_width / aspect, camera.height)
    width = int(np.clip(round(height * aspect), min(LEAST_SIDE, max_width), max_width))
    height = int(np.clip(round(height), min(LEAST_SIDE, max_height), max_height))
    half = np.tan(camera.fov / 2)
    # Each focal length of its own: the page stretches the picture over its canvas.
    pinhole = PinholeCamera(0.5 * width / (half * aspect), 0.5 * height / half, width / 2, height / 2, width, height)
    T = np.eye(4)
    T[:3, :3] = matrix_from_quaternion(camera.wxyz)
    T[:3, 3] = camera.position / units
    return pinhole, inverse_se3(T)


def picture_of(view: RenderedView, mode: str, scene_depth: float) -> NDArray[np.uint8]:
    """Colour, depth or opacity as a picture (H, W, 3)."""
    if mode == "depth":
        return depth_colours(view, scene_depth)
    if mode == "opacity":
        return np.repeat(eight_bits(view.opacity)[..., None], 3, axis=2)
    return eight_bits(view.colour)


def nearest_photograph(
    poses: NDArray[np.float64], T_camera_world: NDArray[np.float64], scene_depth: float
) -> int | None:
    """Which of the poses (N, 4, 4) sees most of what T_camera_world (4, 4) does; None where there is none.

    By where the points at the scene's depth lie that both look at, and by where both are.
    """
    if len(poses) == 0:
        return None
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    centre = -T_camera_world[:3, :3].T @ T_camera_world[:3, 3]
    towards = centres + scene_depth * poses[:, 2, :3] - (centre + scene_depth * T_camera_world[2, :3])
    return int(np.argmin(np.linalg.norm(towards, axis=1) + 0.5 * np.linalg.norm(centres - centre, axis=1)))


def image_error(
    view: RenderedView,
    camera: PinholeCamera,
    T_camera_world: NDArray[np.float64],
    photograph: Photograph,
    seen: RenderedView,
) -> NDArray[np.float32]:
    """How far the picture is from what a photograph shows of the same places: mean absolute difference (H, W).

    Each pixel of `view` is looked up in the photograph by the map's depth there. seen: the map from the photograph's
    own camera, which tells what is hidden from it. NaN where the photograph shows nothing of the place.
    """
    import cv2

    z = view.expected_depth().astype(np.float64)
    row, column = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([column.ravel() + 0.5, row.ravel() + 0.5], axis=1)
    to_photograph = photograph.T_camera_world @ inverse_se3(T_camera_world)
    points = camera.unproject(pixels, z.ravel()) @ to_photograph[:3, :3].T + to_photograph[:3, 3]
    before = (z.ravel() > 0) & (points[:, 2] > 1e-6 * np.maximum(z.ravel(), 1e-12))
    places = photograph.camera.project(np.where(before[:, None], points, [0.0, 0.0, 1.0]))
    before &= photograph.camera.contains(places)
    x, y = (np.where(before, places[:, i] - 0.5, -2.0).reshape(z.shape).astype(np.float32) for i in range(2))

    def look_up(image: NDArray, interpolation: int = cv2.INTER_LINEAR) -> NDArray:
        return cv2.remap(np.ascontiguousarray(image), x, y, interpolation, borderMode=cv2.BORDER_REPLICATE)

    there = look_up(seen.expected_depth().astype(np.float32), cv2.INTER_NEAREST)
    same = np.abs(there - points[:, 2].reshape(z.shape)) <= SAME_SURFACE * np.maximum(there, 1e-12)
    valid = look_up(photograph.rgba[..., 3], cv2.INTER_NEAREST) == 255
    colour = view.colour
    if photograph.exposure is not None:
        colour = colour @ photograph.exposure[:, :3].T + photograph.exposure[:, 3]
    if photograph.vignette is not None:
        size = photograph.camera.width, photograph.camera.height
        colour = colour * look_up(cv2.resize(photograph.vignette, size, interpolation=cv2.INTER_AREA))
    shown = look_up(photograph.rgba[..., :3].astype(np.float32) / 255.0)
    error = np.abs(np.clip(colour, 0.0, 1.0) - shown).mean(axis=2)
    return np.where(before.reshape(z.shape) & same & valid, error, np.nan).astype(np.float32)


def coloured_error(error: NDArray[np.float32]) -> NDArray[np.uint8]:
    """An error (H, W) as colours (H, W, 3), blue for none, red for large; dark grey where there is none to tell."""
    import cv2

    known = np.isfinite(error)
    scaled = eight_bits(np.where(known, error, 0.0) / LARGEST_ERROR)
    colours = cv2.applyColorMap(scaled, cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(known[..., None], colours, UNSEEN).astype(np.uint8)


def error_picture(
    view: RenderedView,
    camera: PinholeCamera,
    T_camera_world: NDArray[np.float64],
    photograph: Photograph,
    seen: RenderedView,
) -> NDArray[np.uint8]:
    """`image_error` as colours (H, W, 3)."""
    return coloured_error(image_error(view, camera, T_camera_world, photograph, seen))

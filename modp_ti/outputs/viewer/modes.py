"""The display modes: splats that a browser draws, and pictures that the renderer computes for its camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import camera_centres, inverse_se3, matrices_from_unit_quaternions, matrix_from_quaternion
from fields.map.gaussians import SH_C0
from modp_ti.outputs.playback.film import DEPTH_RANGE, depth_colours
from modp_ti.outputs.playback.map_renderer import eight_bits
from modp_ti.outputs.viewer.handover import BrowserCamera
from pipelines.render.renderer import RenderedView
from pipelines.whole.coverage import THIN, SeenDepth, where_to_film, widest_angles

# The browser draws splats itself. The other modes are background pictures from this program's renderer.
SPLATS = "splats"
MODES = (SPLATS, "colour", "depth", "opacity", "thin", "error")
# Valid ranges of a browser's field of view [rad] and canvas aspect (width / height). Others are ignored as faulty.
FIELDS_OF_VIEW = (np.radians(1.0), np.radians(170.0))
ASPECTS = (0.1, 10.0)
LEAST_SIDE = 16
# Mean absolute colour difference, in [0, 1], at which the error scale ends.
LARGEST_ERROR = 0.25
# Grey value of pixels that no photograph shows and that therefore have no error.
UNSEEN = 40
# Angle at which the scale of thin places ends [degrees]; every so many-th pixel has one.
WIDE, EVERY = 2 * THIN, 4
ARROW = (255, 255, 255)
# A photograph sees a surface if the map's depth there agrees within this relative tolerance.
SAME_SURFACE = 0.05


@dataclass(frozen=True)
class Splats:
    """Splats in the page's units.

    Attributes:
        centres: (N, 3).
        covariances: (N, 3, 3).
        colours: (N, 3) uint8.
        opacities: (N, 1) uint8.
        of: Number of Gaussians of the map, which may be larger than N.
    """

    centres: NDArray[np.float32]
    covariances: NDArray[np.float32]
    colours: NDArray[np.uint8]
    opacities: NDArray[np.uint8]
    of: int


def splats_of(state: Mapping[str, NDArray], units: float, limit: int) -> Splats:
    """Convert Gaussians, named as in `GaussianField.to_numpy`, to splats with their constant (degree 0) colours.

    If there are more than `limit`, every n-th Gaussian is kept and enlarged to cover the area of those left out.
    `units` is the number of page units per world unit.
    """
    count = len(state["position"])
    chosen = np.arange(count) if count <= limit else np.arange(limit) * count // limit
    larger = np.sqrt(count / len(chosen)) if len(chosen) else 1.0
    q = state["quaternion"][chosen].astype(np.float32)
    R = matrices_from_unit_quaternions(q / np.linalg.norm(q, axis=1, keepdims=True))
    M = R * (np.exp(state["log_scale"][chosen]) * np.float32(units * larger))[:, None, :]
    opacity = 1.0 / (1.0 + np.exp(-state["opacity_logit"][chosen]))
    colour = np.clip(0.5 + SH_C0 * state["sh"][chosen, 0], 0.0, 1.0)
    return Splats(
        state["position"][chosen] * np.float32(units),
        M @ M.transpose(0, 2, 1),
        np.round(255.0 * colour).astype(np.uint8),
        np.round(255.0 * opacity[:, None]).astype(np.uint8),
        count,
    )


def frustum_lines(poses: NDArray[np.float64], camera: PinholeCamera, units: float, depth: float) -> NDArray[np.float32]:
    """Return the edges (8 N, 2, 3) of camera frustums in page units, for T_camera_world (N, 4, 4).

    `units` is the number of page units per world unit, `depth` that of a frustum [page units].
    """
    w, h = camera.width, camera.height
    corners = camera.unproject(np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]), np.full(4, depth))
    centres = camera_centres(poses) * units
    ends = centres[:, None] + np.einsum("nji,kj->nki", poses[:, :3, :3], corners)
    sides = np.stack([np.broadcast_to(centres[:, None], ends.shape), ends], axis=2)
    around = np.stack([ends, np.roll(ends, -1, axis=1)], axis=2)
    return np.concatenate([sides, around], axis=1).reshape(-1, 2, 3).astype(np.float32)


@dataclass(frozen=True)
class Photograph:
    """A frame's image, to compare the map with.

    Attributes:
        rgba: (H, W, 4) uint8; alpha is 255 where the pixel is valid.
        camera: The frame's camera.
        T_camera_world: (4, 4) refined pose.
        exposure: (3, 4) as in `Keyframe`, or None.
        vignette: (H', W', 3) of any size as in `Keyframe`, or None.
    """

    rgba: NDArray[np.uint8]
    camera: PinholeCamera
    T_camera_world: NDArray[np.float64]
    exposure: NDArray[np.float64] | None = None
    vignette: NDArray[np.float32] | None = None


def pinhole_of(
    camera: BrowserCamera, units: float, max_width: int, max_height: int
) -> tuple[PinholeCamera, NDArray[np.float64]] | None:
    """Return a browser's camera as a pinhole camera and T_camera_world (4, 4), or None if its numbers are invalid.

    The picture has the canvas's aspect ratio and the largest size that fits into `max_width` x `max_height` pixels.
    `units` is the number of page units per world unit.
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
    # fx and fy are computed separately, because the page stretches the picture over its canvas.
    pinhole = PinholeCamera(0.5 * width / (half * aspect), 0.5 * height / half, width / 2, height / 2, width, height)
    T = np.eye(4)
    T[:3, :3] = matrix_from_quaternion(camera.wxyz)
    T[:3, 3] = camera.position / units
    return pinhole, inverse_se3(T)


def painter(
    browser: BrowserCamera,
    units: float,
    render: Callable[[PinholeCamera, NDArray[np.float64]], RenderedView],
    largest: tuple[int, int],
    scene_depth: float,
    poses: NDArray[np.float64],
    photograph: Callable[[int], Photograph],
    seen: Callable[[], Sequence[SeenDepth]],
) -> Callable[[], NDArray[np.uint8]] | None:
    """Render what a browser's mode needs.

    Args:
        browser: The camera to show the map from, and the mode, one of MODES except for SPLATS.
        units: Page units per world unit.
        render: Renders the map from a camera and T_camera_world (4, 4).
        largest: Largest width and height of a picture [px].
        scene_depth: The scene's depth [scene units].
        poses: (N, 4, 4) T_camera_world of the photographs, for the error mode.
        photograph: Returns the photograph with this index among `poses`.
        seen: Returns what the keyframes see, for the mode of thin places.

    Returns:
        A function that computes the picture (H, W, 3) and does not use the map any more; None if the browser's camera
        is invalid or the renderer's capacity does not suffice, as can happen inside large Gaussians.
    """
    seen_from = pinhole_of(browser, units, *largest)
    if seen_from is None:
        return None
    camera, T_camera_world = seen_from
    try:
        view = render(camera, T_camera_world)
        if browser.mode == "thin":
            depths = seen()
            return lambda: thin_picture(view, camera, T_camera_world, depths, scene_depth)
        if browser.mode != "error":
            return lambda: picture_of(view, browser.mode, scene_depth)
        taken = photograph(nearest_photograph(poses, T_camera_world, scene_depth))
        there = render(taken.camera, taken.T_camera_world)
    except ValueError:
        return None
    return lambda: error_picture(image_error(view, camera, T_camera_world, taken, there))


def picture_of(view: RenderedView, mode: str, scene_depth: float) -> NDArray[np.uint8]:
    """Return colour, depth or opacity of a view as a picture (H, W, 3)."""
    if mode == "depth":
        return depth_colours(view, scene_depth)
    if mode == "opacity":
        return np.repeat(eight_bits(view.opacity)[..., None], 3, axis=2)
    return eight_bits(view.colour)


def scale_of(mode: str, scene_depth: float) -> str:
    """Return what the colours of a mode mean, as HTML: a bar with numbers. Empty for modes that need none."""
    steps = np.linspace(0, 255, 9).round().astype(np.uint8)[None]
    turbo = cv2.applyColorMap(steps, cv2.COLORMAP_TURBO)[0, :, ::-1]
    if mode == "depth":  # `depth_colours`: red is near
        ends = [scene_depth / DEPTH_RANGE, scene_depth, scene_depth * DEPTH_RANGE]
        colours, what = turbo[::-1], "depth [scene units], logarithmic"
    elif mode == "error":
        ends, colours, what = [0.0, LARGEST_ERROR / 2, LARGEST_ERROR], turbo, "mean colour difference, of 1"
    elif mode == "thin":
        ends, colours, what = [0.0, THIN, WIDE], turbo[::-1], "widest angle between keyframes [degrees]"
    elif mode == "opacity":
        ends, colours, what = [0.0, 0.5, 1.0], np.repeat(steps[0, :, None], 3, axis=1), "opacity"
    else:
        return ""
    stops = ",".join(f"rgb({r},{g},{b})" for r, g, b in colours.tolist())
    numbers = "".join(f"<span>{number:.3g}</span>" for number in ends)
    return (
        f'<div style="margin:0 0.75em;font-size:0.8em">{what}<div style="height:0.8em;background:linear-gradient(90deg,'
        f'{stops})"></div><div style="display:flex;justify-content:space-between">{numbers}</div></div>'
    )


def nearest_photograph(poses: NDArray[np.float64], T_camera_world: NDArray[np.float64], scene_depth: float) -> int:
    """Return the index of the pose among (N, 4, 4) T_camera_world, N > 0, that shares most of its view with a pose.

    The measure adds the distance between the points at the scene's depth on both optical axes and half the distance
    between the camera centres.
    """
    centres = camera_centres(poses)
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
    """Compare a rendered view with a photograph of the same places.

    Each pixel of `view` is projected into the photograph with the map's depth.

    Args:
        view: Rendered view.
        camera: Camera of `view`.
        T_camera_world: (4, 4) pose of `view`.
        photograph: Image to compare with.
        seen: The map rendered from the photograph's camera, used to detect occlusion.

    Returns:
        (H, W) mean absolute colour difference, NaN where the photograph does not show the place.
    """
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


def thin_picture(
    view: RenderedView,
    camera: PinholeCamera,
    T_camera_world: NDArray[np.float64],
    seen: Sequence[SeenDepth],
    scene_depth: float,
) -> NDArray[np.uint8]:
    """Colour a view by how wide an angle its places are seen from: red for one direction, blue for WIDE and more.

    Dark grey is seen by no keyframe. An arrow leads from where to stand to what to film next, if anything is thin.

    Args:
        view: Rendered view.
        camera: Camera of `view`.
        T_camera_world: (4, 4) pose of `view`.
        seen: What the keyframes see.
        scene_depth: The scene's depth [scene units].

    Returns:
        Picture (H, W, 3).
    """
    z = view.expected_depth().astype(np.float64)[EVERY // 2 :: EVERY, EVERY // 2 :: EVERY]
    pixels = EVERY * (np.stack(np.meshgrid(*map(np.arange, z.shape[::-1])), axis=-1).reshape(-1, 2) + 0.5)
    T_world_camera = inverse_se3(T_camera_world)
    points = camera.unproject(pixels, z.ravel()) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    angles = np.where(z.ravel() > 0, widest_angles(points, seen, scene_depth), np.nan)
    scaled = eight_bits(1.0 - np.clip(np.nan_to_num(angles), 0.0, WIDE) / WIDE).reshape(z.shape)
    colours = cv2.applyColorMap(scaled, cv2.COLORMAP_TURBO)[..., ::-1]
    colours = np.where(np.isfinite(angles).reshape(z.shape)[..., None], colours, UNSEEN).astype(np.uint8)
    size = camera.width, camera.height
    colours = cv2.resize(colours, size, interpolation=cv2.INTER_NEAREST).astype(np.float32)
    grey = 255.0 * np.clip(view.colour, 0.0, 1.0).mean(axis=2, keepdims=True)
    picture = np.ascontiguousarray(np.round(0.5 * (colours + grey)).astype(np.uint8))
    way = where_to_film(points, angles, seen)
    if way is not None:
        place, target = (T_camera_world[:3, :3] @ end + T_camera_world[:3, 3] for end in way)
        head = camera.project(target[None])[0]
        # A place behind the camera, or next to it, is shown by its direction.
        aside = place[:2] / max(float(np.linalg.norm(place[:2])), 1e-9)
        tail = camera.project(place[None])[0] if place[2] > 0.1 * target[2] else (0.5 + 0.45 * aside) * size
        (x0, y0), (x1, y1) = (np.clip(end, 0, size).round().astype(int).tolist() for end in (tail, head))
        cv2.arrowedLine(picture, (x0, y0), (x1, y1), ARROW, max(2, camera.width // 200), cv2.LINE_AA, tipLength=0.15)
    return picture


def error_picture(error: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return `image_error` as colours (H, W, 3): blue for 0, red for LARGEST_ERROR and more, dark grey for NaN."""
    known = np.isfinite(error)
    scaled = eight_bits(np.where(known, error, 0.0) / LARGEST_ERROR)
    colours = cv2.applyColorMap(scaled, cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(known[..., None], colours, UNSEEN).astype(np.uint8)

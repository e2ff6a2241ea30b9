"""`Locator`: finds the poses of new pictures in a finished map."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from fields.frames.origin import shifted_poses
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.runtime.tenancy import Tenant
from modp_ti.config.scene_file import scene_from_data
from modp_ti.inputs.source_settings import IntrinsicsSettings
from modp_ti.inputs.sources.image_folder import ListedImages
from modp_ti.inputs.sources.undistortion import Intrinsics, given_intrinsics
from modp_ti.outputs.locating.search import MapViews, Search, map_depth
from modp_ti.outputs.locating.world_alignment import PlacedFrame
from modp_ti.outputs.playback.finished_run import FinishedRun, open_run
from modp_ti.outputs.playback.map_renderer import MapRenderer, start_device
from modp_ti.outputs.progress import ProgressLine

# Largest relative difference of the aspect ratios of pictures from one camera, which allows for rounding.
SAME_ASPECT = 0.005
# Most keyframes that the map is rendered from, evenly spaced.
MOST_VIEWS = 400


def given_camera(text: str) -> IntrinsicsSettings:
    """Parse a camera such as `fx=525.5,cx=320,k1=-0.03`, with the keys of `source.intrinsics`.

    Raises:
        InputError: If a key is unknown or a value is invalid.
    """
    overrides: Sequence[str] = [f"source.intrinsics.{part.strip()}" for part in text.split(",")]
    scene = {"source": {"path": "."}, "tracker": {"kind": "klt"}, "output": "."}
    return scene_from_data(scene, f"--camera {text}", overrides).source.intrinsics


def _camera_of(
    run: FinishedRun, width: int, height: int, given: IntrinsicsSettings | None
) -> tuple[Intrinsics, bool, str]:
    """Choose the camera of a picture of `width` x `height` pixels.

    It is the given one; or that of the run, if the shape of the picture is that of the run's images; or else a guess
    with the field of view of the run. Returns it, whether it is known, and where it is from.
    """
    size = f"{width}x{height}"
    if given is not None and given.given:
        return given_intrinsics(given, width, height), True, f"{size} pictures: the given camera"
    mapped = Intrinsics(run.cameras[run.record.keyframes[0]])
    stored = run.record.stored_camera
    # A picture of exactly the mapped size is one that was undistorted with the run's images, or rendered.
    sizes = [(each.camera.width, each.camera.height) for each in (mapped, stored or mapped)]
    own = mapped if stored is None or (sizes[0] == (width, height) != sizes[1]) else stored
    if abs(own.camera.width * height / (own.camera.height * width) - 1.0) <= SAME_ASPECT:
        lens = "" if stored is not None else ", without lens distortion, which the run has not recorded"
        camera = Intrinsics(own.camera.resized(width, height), own.distortion)
        return camera, True, f"{size} pictures: the run's camera{lens}"
    focal = mapped.camera.focal * max(width, height) / max(mapped.camera.width, mapped.camera.height)
    guess = PinholeCamera(focal, focal, width / 2, height / 2, width, height)
    note = f"{size} pictures are not of the run's camera: their focal length is estimated; --camera gives it"
    return Intrinsics(guess), False, note


@dataclass(frozen=True)
class Location:
    """Where a picture was taken.

    Attributes:
        name: Name of the picture.
        T_camera_world: Pose (4, 4) in the world of the run's poses, OpenCV axes; None if it was not found.
        reason: Why it was not found; empty otherwise.
        inliers: Number of features that the picture and the render of the map from this pose show at the same place.
        likeness: Correlation of the picture and this render, from -1 to 1.
        covariance: Covariance (6, 6) of the tangent (translation, rotation) of exp(xi) T_camera_world [scene units,
            rad], by the reprojection errors of the inliers; None if the pose was not found.
        camera: Camera of the picture at its own size, without its lens distortion; None if the pose was not found.
        note: Where the camera is from.

    Example:
        location: modp_ti.Location = modp_ti.Locator("out/room").locate("new.jpg")
        print(location.reason if location.T_camera_world is None else location.T_camera_world)
    """

    name: str
    T_camera_world: NDArray[np.float64] | None = None
    reason: str = ""
    inliers: int = 0
    likeness: float = 0.0
    covariance: NDArray[np.float64] | None = None
    camera: PinholeCamera | None = None
    note: str = ""


class Locator(Tenant):
    """Locates pictures in the map of a finished run.

    The map is rendered from its keyframes. Features of a picture are matched with those of the renders that resemble
    it, whose places are known from the rendered depth, and give a first pose. It is refined with a render from this
    pose, first by features and then photometrically. A pose is accepted only if the picture and the render from it
    have features in common at the same places, and look alike.

    This starts the device, as `initialise` does, unless a map is in use in this process: then the two share it.

    Args:
        output: Output folder of a run. Only the map and its poses are read, not the images.
        device: "cpu", "cuda", "vulkan", "metal" or "auto".
        console: Receives the progress, None for no output.

    Raises:
        InputError: If the folder holds no finished run, or a map is in use on another device.
        RuntimeError: If there is no room next to the maps in use. Methods raise it once `initialise` is called again.

    Example:
        locator = modp_ti.Locator("out/room")
        location = locator.locate("new.jpg")
        print(location.T_camera_world, location.inliers)
    """

    def __init__(self, output: str | os.PathLike[str], device: str = "auto", console: Console | None = None) -> None:
        line = ProgressLine(console or Console(quiet=True))
        with line.working("loading the map"):
            self._run = run = open_run(Path(output))
            gaussians = run.gaussians
            start_device(device)
        keyframes = run.record.keyframes
        count = min(len(keyframes), MOST_VIEWS)
        shown = [keyframes[i * len(keyframes) // count] for i in range(count)]
        cameras = [run.cameras[index] for index in shown]
        self._side = max(max(camera.width, camera.height) for camera in cameras)
        self._renderer = renderer = MapRenderer(gaussians, self._side, self._side, run.record.near)
        self.tenancy = renderer.tenancy
        shots = list(zip(cameras, run.poses[shown], strict=True))
        views = MapViews(renderer, line.through("rendering the map", shots, len(shots)))
        self._search = Search(renderer, views)

    def locate(
        self,
        picture: str | os.PathLike[str] | NDArray[np.uint8],
        camera: IntrinsicsSettings | None = None,
        name: str | None = None,
    ) -> Location:
        """Locate one picture.

        Args:
            picture: An image file, or an image (H, W, 3) uint8 RGB.
            camera: The picture's camera, as `source.intrinsics` of a scene. None: the run's camera if the picture has
                the shape of the run's images; otherwise the focal length is estimated.
            name: Name for the result; None for that of the file.

        Raises:
            InputError: If the file cannot be read as an image, or the camera is of another image size.
        """
        if isinstance(picture, np.ndarray):
            raw, name = picture, name or "picture"
        else:
            path = Path(picture)  # decoded and turned as the images of a run
            raw, name = ListedImages(path.parent, [path.name], [0.0]).read(path.name), name or os.fspath(picture)
        height, width = raw.shape[:2]
        intrinsics, known, note = _camera_of(self._run, width, height, camera)
        undistorter = intrinsics.undistorter(min(1.0, self._side / max(width, height)))
        image, valid = undistorter.image(raw)
        found = self._search.find(image, valid, undistorter.camera, not known)
        if isinstance(found, str):
            return Location(name, reason=found, note=note)
        return Location(
            name,
            shifted_poses(found.T_camera_world, self._run.record.origin),
            "",
            found.inliers,
            found.likeness,
            found.covariance,
            found.camera.resized(width, height),
            note,
        )

    def place(self, frame: TrackedFrame) -> PlacedFrame | str:
        """Locate a frame of a tracker, and find the depths of its points in the map.

        Returns:
            The located frame, or why it was not located.
        """
        camera, image, valid = frame.camera, frame.image, frame.mask
        factor = min(1.0, self._side / max(camera.width, camera.height))
        if factor < 1.0:  # larger than the map's renders
            size = max(1, round(camera.width * factor)), max(1, round(camera.height * factor))
            camera = camera.resized(*size)
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
            valid = None if valid is None else cv2.resize(valid.astype(np.float32), size) >= 0.5
        found = self._search.find(image, valid, camera)
        if isinstance(found, str):
            return found
        points = frame.points
        pixels = points.pixels * np.divide((camera.width, camera.height), (frame.camera.width, frame.camera.height))
        depth = map_depth(self._renderer, camera, found.T_camera_world, pixels)
        known = depth > 0
        T_map, T_tracker = found.T_camera_world, frame.T_camera_world
        return PlacedFrame(frame.index, camera, T_map, T_tracker, points.ids[known], depth[known], points.xyz[known])

"""Films a finished map: plans the camera path, the lens and the frame rate, and renders them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import shifted_poses
from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.run_files import read_exposures
from modp_ti.outputs.formats.trajectory import read_trajectory
from modp_ti.outputs.playback.camera_paths import orbit, smoothed
from modp_ti.outputs.playback.film import depth_colours, is_video, require_writable, write_pictures, write_video
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.map_renderer import MapRenderer, eight_bits, start_device
from modp_ti.outputs.progress import ProgressLine
from pipelines.render.renderer import RenderedView

__all__ = ["PATHS", "Flight", "film", "plan_flight"]

PATHS = ("recorded", "smoothed", "orbit")
# Number of pictures and frame rate of paths that do not define their own.
DEFAULT_FRAMES = 240
DEFAULT_FPS = 30.0
DEVIATION = 5.0


@dataclass(frozen=True)
class Flight:
    """A planned film.

    Attributes:
        poses: (M, 4, 4) T_camera_world.
        cameras: Camera at each pose.
        frames_per_second: Frame rate.
        exposures: (3, 4) matrix (A, b) at each pose, which maps colours to A colour + b. None for the map's colours.
    """

    poses: NDArray[np.float64]
    cameras: list[PinholeCamera]
    frames_per_second: float
    exposures: list[NDArray[np.float64]] | None = None


def plan_flight(
    run: FinishedRun,
    path: str,
    size: tuple[int, int] | None = None,
    fov: float | None = None,
    frames: int | None = None,
    fps: float | None = None,
    deviation: float | None = None,
    exposure: bool = False,
) -> Flight:
    """Plan a flight along a path.

    Args:
        run: The finished run.
        path: One of PATHS, or a trajectory file in TUM format.
        size: (width, height) [px], None for the recorded size.
        fov: Horizontal field of view [degrees], None for the recorded one.
        frames: Number of pictures of a smoothed path or an orbit, None for the default.
        fps: Frame rate, None for that of the path's time stamps.
        deviation: Standard deviation of the smoothing of a smoothed path [frames], None for the default.
        exposure: Apply each frame's exposure. Only for the recorded path.

    Raises:
        InputError: If the path is unknown, its file is invalid, `frames` is given for a path with its own poses,
            `deviation` for another path than a smoothed one, or the exposures are not available.
    """
    exposures = _exposures(run, path) if exposure else None
    times = None
    if deviation is not None and path != "smoothed":
        raise InputError(f"--smooth is for the path `smoothed`, not for {path}: leave it out")
    if path == "smoothed":
        deviation = DEVIATION if deviation is None else deviation
        poses = smoothed(run.poses[run.way], frames or max(DEFAULT_FRAMES, len(run.way)), deviation)
    elif path == "orbit":
        poses = orbit(run.poses[run.record.keyframes], run.record.scene_depth, frames or DEFAULT_FRAMES)
    else:
        if frames is not None:
            raise InputError("--frames is for the paths `smoothed` and `orbit`: the others have poses of their own")
        if path == "recorded":
            times, poses = run.timestamps[run.way], run.poses[run.way]
        elif Path(path).expanduser().is_file():
            times, poses = read_trajectory(Path(path).expanduser())
            poses = shifted_poses(poses, -run.record.origin)
        else:
            raise InputError(f"--path {path}: no such file, and none of {', '.join(PATHS)}")
    if len(poses) == 0:
        raise InputError(f"--path {path}: holds no pose")
    own = (
        [run.cameras[i] for i in run.way] if path == "recorded" else [run.cameras[run.record.keyframes[0]]] * len(poses)
    )
    cameras = [_lens(camera, size, fov) for camera in own]
    return Flight(poses, cameras, fps or _rate(times), exposures)


def film(run: FinishedRun, flight: Flight, output: Path, depth: bool, device: str, line: ProgressLine) -> None:
    """Render a flight to a video or a folder of pictures, depending on the name of `output`.

    Args:
        run: The finished run.
        flight: The planned flight.
        output: A video file or a folder.
        depth: Render depth instead of colour.
        device: "cpu", "cuda", "vulkan", "metal" or "auto".
        line: Shows the progress.

    Raises:
        InputError: If the output cannot be written. This is checked before rendering.
    """
    require_writable(output)
    with line.working("loading the map"):
        gaussians = run.gaussians
        start_device(device)
        width, height = (max(getattr(c, side) for c in flight.cameras) for side in ("width", "height"))
        renderer = MapRenderer(gaussians, width, height, run.record.near)

    def views() -> Iterator[RenderedView]:
        exposures = flight.exposures or [None] * len(flight.poses)
        shots = list(zip(flight.cameras, flight.poses, exposures, strict=True))
        for camera, T, exposure in line.through("rendering", shots, len(shots)):
            view = renderer.view(camera, T)
            yield view if exposure is None else replace(view, colour=view.colour @ exposure[:, :3].T + exposure[:, 3])

    if not is_video(output):
        write_pictures(output, views(), depth)
        return
    show: Callable[[RenderedView], NDArray[np.uint8]]
    show = (lambda v: depth_colours(v, run.record.scene_depth)) if depth else (lambda v: eight_bits(v.colour))
    write_video(output, (show(view) for view in views()), flight.frames_per_second)


def _exposures(run: FinishedRun, path: str) -> list[NDArray[np.float64]]:
    """Return the exposure of every recorded frame. Raises InputError if unavailable or if the path is another one."""
    if path != "recorded":
        raise InputError(f"--exposure is of the recorded frames: --path {path} has none of its own")
    known = read_exposures(run.folder / "exposure.json")
    if not known:
        raise InputError(f"{run.folder}: no exposures were estimated (mapping.exposure.enabled): leave out --exposure")
    if missing := [index for index in range(len(run)) if index not in known]:
        raise InputError(f"{run.folder / 'exposure.json'}: frame {missing[0]} is missing")
    return [known[index] for index in run.way.tolist()]


def _lens(camera: PinholeCamera, size: tuple[int, int] | None, fov: float | None) -> PinholeCamera:
    """Return the camera with another size and field of view. Without `fov`, the horizontal field of view is kept."""
    width, height = size or (camera.width, camera.height)
    if fov is not None:
        focal = 0.5 * width / np.tan(np.radians(fov) / 2)
        return PinholeCamera(focal, focal, width / 2, height / 2, width, height)
    s = width / camera.width
    cy = height / 2 + s * (camera.cy - camera.height / 2)
    return PinholeCamera(s * camera.fx, s * camera.fy, s * camera.cx, cy, width, height)


def _rate(times: NDArray[np.float64] | None) -> float:
    """Return the frame rate of a path with these time stamps [s], limited to 1 to 60 Hz."""
    steps = np.diff(times) if times is not None else np.zeros(0)
    steps = steps[steps > 0]
    return float(np.clip(1.0 / np.median(steps), 1.0, 60.0)) if len(steps) else DEFAULT_FPS

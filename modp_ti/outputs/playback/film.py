"""Films a finished map: plans the flight, renders it, and writes videos and pictures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import shifted_poses
from fields.geometry.camera import PinholeCamera
from modp_ti.files.atomic import written_aside
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.compressed_splats import HALF_TURN
from modp_ti.outputs.formats.dataset import new_folder
from modp_ti.outputs.formats.mesh import LARGEST_STEP
from modp_ti.outputs.formats.run_files import read_exposures
from modp_ti.outputs.formats.spherical import mark_spherical_mp4, spherical_png
from modp_ti.outputs.formats.trajectory import read_trajectory
from modp_ti.outputs.playback.camera_paths import orbit, smoothed, upright
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.map_renderer import MapRenderer, eight_bits, start_device
from modp_ti.outputs.playback.panoramas import PanoramaRenderer
from modp_ti.outputs.progress import ProgressLine
from modp_ti.outputs.splat_page.page import levelled
from pipelines.render.renderer import RenderedView

Shown = Literal["colour", "depth", "normals"]
Encoding = Literal["tiff", "exr", "png"]

# Codec by suffix, its options, and those of the file, whose index stands in front so that a browser plays while it
# loads. Every browser plays both; H.264 is much faster to write.
VIDEO_SUFFIXES = {
    ".mp4": ("libx264", {"crf": "18", "preset": "fast"}, {"movflags": "+faststart"}),
    ".webm": ("libvpx-vp9", {"crf": "24", "b": "0", "deadline": "good", "cpu-used": "4", "row-mt": "1"}, {}),
}
# The number of BT.709 for primaries, transfer and matrix (ITU-T H.273), and swscale's flags for colours without a bias:
# bicubic, accurate rounding, chroma from every pixel.
BT709, UNBIASED = 1, 0x4 | 0x40000 | 0x2000 | 0x4000
# The depth colours range from the scene's depth divided by this factor to the depth times this factor.
DEPTH_RANGE = 4.0
PATHS = ("recorded", "smoothed", "orbit")
# Number of pictures and frame rate of paths that do not define their own, and default smoothing [frames].
DEFAULT_FRAMES = 240
DEFAULT_FPS = 30.0
DEVIATION = 5.0


def is_video(path: Path) -> bool:
    """Return whether a path names a video; otherwise it is a folder of pictures.

    Raises:
        InputError: If the suffix is that of another kind of file.
    """
    suffix = path.suffix.lower()
    if suffix in (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".avi", ".mov", ".mkv", ".gif"):
        raise InputError(f"{path}: give a name in .mp4 or .webm for a video, or a folder for pictures")
    return suffix in VIDEO_SUFFIXES


def write_pictures(
    folder: Path,
    pictures: Iterable[NDArray],
    encoding: Encoding = "tiff",
    unit: float = 1.0,
    spherical: bool = False,
) -> None:
    """Write one file per picture, from 000000. The folder appears whole or not at all.

    Args:
        folder: The folder, which must be new or empty.
        pictures: Colours (H, W, 3) uint8, depths (H, W) or unit normals (H, W, 3).
        encoding: Of depths and normals: "tiff" and "exr" with float32 values, or "png" with 16 bits, 0 where unknown.
            Colours are always PNG.
        unit: Of "png": a step of the depth [scene units]. Of normals, [-1, 1] are 1 to 65535.
        spherical: Whether colours say that they are equirectangular.

    Raises:
        InputError: If the files cannot be written.
    """
    try:
        with new_folder(folder) as partial:
            for number, picture in enumerate(pictures):
                form: Encoding = "png" if picture.dtype == np.uint8 else encoding
                data = _encoded(picture, form, unit)
                marked = spherical and picture.dtype == np.uint8
                (partial / f"{number:06d}.{form}").write_bytes(spherical_png(data) if marked else data)
                if number == 0 and form == "png" and picture.ndim == 2:
                    (partial / "unit.json").write_text(f'{{"scene_units": {unit:g}}}\n')
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None


def _encoded(picture: NDArray, form: Encoding, unit: float) -> bytes:
    if picture.dtype != np.uint8:
        known = picture != 0 if picture.ndim == 2 else picture.any(axis=2, keepdims=True)
        picture = picture.astype(np.float32)
        if form == "png":
            steps = picture / unit if picture.ndim == 2 else 32768.0 + 32767.0 * picture
            picture = np.where(known & (steps < 65535.5), np.round(steps), 0).astype(np.uint16)
    if form == "exr":
        import av

        encoder = av.CodecContext.create("exr", "w")
        assert isinstance(encoder, av.VideoCodecContext)
        encoder.height, encoder.width = picture.shape[:2]
        encoder.pix_fmt, encoder.time_base = "gbrpf32le" if picture.ndim == 3 else "grayf32le", Fraction(1)
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format=encoder.pix_fmt)
        return b"".join(bytes(packet) for packet in [*encoder.encode(frame), *encoder.encode(None)])
    return cv2.imencode(f".{form}", picture[..., ::-1] if picture.ndim == 3 else picture)[1].tobytes()


def write_video(
    path: Path, pictures: Iterable[NDArray[np.uint8]], frames_per_second: float, spherical: bool = False
) -> None:
    """Write a video: H.264 in .mp4, VP9 in .webm, 4:2:0 in the colours of BT.709. It appears whole or not at all.

    Args:
        path: The file, with a suffix of VIDEO_SUFFIXES.
        pictures: (H, W, 3) uint8 RGB, at least one, all of one size. An odd last row or column is cropped, since 4:2:0
            needs even sizes; a single one is doubled.
        frames_per_second: Frame rate.
        spherical: Whether an .mp4 says that it is equirectangular. Its index then is at the end.

    Raises:
        InputError: If the video cannot be written.
    """
    import av
    import av.error

    codec, options, layout = VIDEO_SUFFIXES[path.suffix.lower()]
    spherical = spherical and path.suffix.lower() == ".mp4"
    pictures = iter(pictures)
    first = next(pictures)
    height, width = (max(side // 2 * 2, 2) for side in first.shape[:2])
    single = [(0, side == 1) for side in first.shape]
    tagged = {"dst_colorspace": BT709, "dst_color_range": 1}  # luma from 16 to 235
    try:
        with written_aside(path) as partial:
            with av.open(str(partial), "w", options={} if spherical else layout) as file:
                stream = file.add_stream(codec, Fraction(frames_per_second).limit_denominator(1001), options)
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                stream.color_primaries = stream.color_trc = stream.colorspace = BT709
                stream.color_range = 1
                for picture in chain([first], pictures):
                    even = np.pad(picture, single, mode="edge")[:height, :width]
                    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
                    file.mux(stream.encode(frame.reformat(format="yuv420p", interpolation=UNBIASED, **tagged)))
                file.mux(stream.encode(None))
            if spherical:
                mark_spherical_mp4(partial)
    except (OSError, av.error.FFmpegError) as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


def depth_colours(view: RenderedView, scene_depth: float) -> NDArray[np.uint8]:
    """Map depth to colours (H, W, 3): red is near, blue is far, black is empty.

    The scale is logarithmic around `scene_depth`.
    """
    z = view.expected_depth()
    near = 0.5 - 0.5 * np.log(np.maximum(z, 1e-12) / scene_depth) / np.log(DEPTH_RANGE)
    colours = cv2.applyColorMap(eight_bits(near), cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(z[..., None] > 0, colours, 0).astype(np.uint8)


def normals(rays: NDArray[np.float64], depth: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the unit normals (H, W, 3) of the surface that a view shows, towards the camera; 0 where unknown.

    Args:
        rays: (H, W, 3) rays of the pixels; a point is its depth times its ray.
        depth: (H, W) depth, 0 where unknown. Across a step of the depth, the surface is not connected.
    """
    points, tangents = rays * depth[..., None], []
    for axis in (0, 1):
        least = np.minimum(np.delete(depth, 0, axis), np.delete(depth, -1, axis))
        same = (least > 0) & (np.abs(np.diff(depth, axis=axis)) <= LARGEST_STEP * least)
        step = np.where(same[..., None], np.diff(points, axis=axis), 0.0)
        none = np.zeros_like(np.take(points, [0], axis))
        tangents.append(np.concatenate([step, none], axis=axis) + np.concatenate([none, step], axis=axis))
    n = np.cross(*tangents)
    return n / np.maximum(np.linalg.norm(n, axis=2, keepdims=True), 1e-30)


@dataclass(frozen=True)
class Flight:
    """A planned film.

    Attributes:
        poses: (M, 4, 4) T_camera_world.
        cameras: Camera at each pose.
        frames_per_second: Frame rate.
        exposures: (3, 4) matrix (A, b) at each pose, which maps colours to A colour + b. None for the map's colours.
        panorama: Width of equirectangular pictures [px]; None for those of the cameras.
    """

    poses: NDArray[np.float64]
    cameras: list[PinholeCamera]
    frames_per_second: float
    exposures: list[NDArray[np.float64]] | None = None
    panorama: int | None = None


def plan_flight(
    run: FinishedRun,
    path: str,
    size: tuple[int, int] | None = None,
    fov: float | None = None,
    frames: int | None = None,
    fps: float | None = None,
    deviation: float | None = None,
    exposure: bool = False,
    panorama: int | None = None,
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
        panorama: Width of equirectangular pictures [px]. But for a path of one's own, their horizon is made level.

    Raises:
        InputError: If the path is unknown, its file is invalid, an option is given that the path ignores, or the
            exposures are not available.
    """
    for option, given, of in (
        ("--smooth", deviation is not None, ("smoothed",)),
        ("--frames", frames is not None, ("smoothed", "orbit")),
        ("--exposure", exposure, ("recorded",)),
    ):
        if given and path not in of:
            raise InputError(f"{option}: is for --path {' and '.join(of)}, not for {path}: leave it out")
    if panorama is not None and (size is not None or fov is not None):
        raise InputError("--panorama: has its own size and sees all round; leave out --size and --fov")
    times = None
    cameras = [run.cameras[run.record.keyframes[0]]]
    if path == "smoothed":
        count = frames or max(DEFAULT_FRAMES, len(run.way))
        poses = smoothed(run.poses[run.way], count, DEVIATION if deviation is None else deviation)
    elif path == "orbit":
        poses = orbit(run.poses[run.record.keyframes], run.record.scene_depth, frames or DEFAULT_FRAMES)
    elif path == "recorded":
        times, poses, cameras = run.timestamps[run.way], run.poses[run.way], [run.cameras[i] for i in run.way]
    elif (file := Path(path).expanduser()).is_file():
        times, poses = read_trajectory(file)
        poses = shifted_poses(poses, -run.record.origin)
    else:
        raise InputError(f"--path {path}: no such file, and none of {', '.join(PATHS)}")
    if len(poses) == 0:
        raise InputError(f"--path {path}: holds no pose")
    if len(cameras) < len(poses):
        cameras *= len(poses)
    if panorama is not None and path in PATHS:
        down = levelled(run).R[1]
        poses = np.stack([upright(T, down) for T in poses])
    return Flight(
        poses,
        [_lens(camera, size, fov) for camera in cameras],
        fps or _rate(times),
        _exposures(run) if exposure else None,
        panorama,
    )


def film(
    run: FinishedRun,
    flight: Flight,
    output: Path,
    show: Shown,
    device: str,
    line: ProgressLine,
    encoding: Encoding | None = None,
) -> None:
    """Render a flight to a video or a folder of pictures, depending on the name of `output`.

    Args:
        run: The finished run.
        flight: The planned flight.
        output: A video file or a new folder.
        show: What is rendered.
        device: "cpu", "cuda", "vulkan", "metal" or "auto".
        line: Shows the progress.
        encoding: Of depth and normals in a folder, None for the default.

    Raises:
        InputError: If the output cannot be written. This is checked before rendering.
    """
    video = is_video(output)
    if encoding is not None and (video or show == "colour"):
        raise InputError("--encoding: is for a folder of depth or normals; leave it out")
    if not output.absolute().parent.is_dir():
        raise InputError(f"{output.absolute().parent}: no such folder; make it first")
    if output.is_dir() if video else output.exists() and not (output.is_dir() and not any(output.iterdir())):
        raise InputError(f"{output}: is there already; name a video in .mp4 or .webm, or a new folder for pictures")
    with line.working("loading the map"):
        gaussians = run.gaussians
        start_device(device)
        if flight.panorama is None:
            width, height = (max(getattr(c, side) for c in flight.cameras) for side in ("width", "height"))
            renderer = MapRenderer(gaussians, width, height, run.record.near)
        else:
            renderer = PanoramaRenderer(gaussians, flight.panorama, run.record.near)

    def pictures() -> Iterator[NDArray]:
        exposures = flight.exposures or [None] * len(flight.poses)
        shots = list(zip(flight.cameras, flight.poses, exposures, strict=True))
        for camera, T, exposure in line.through("rendering", shots, len(shots)):
            view = renderer.view(camera, T)
            if show == "colour":
                developed = view.colour if exposure is None else view.colour @ exposure[:, :3].T + exposure[:, 3]
                yield eight_bits(developed)
            elif show == "depth":
                yield depth_colours(view, run.record.scene_depth) if video else view.expected_depth()
            else:
                n = normals(renderer.rays(camera), view.expected_depth())
                yield eight_bits(n.any(axis=2, keepdims=True) * (0.5 + 0.5 * n * HALF_TURN)) if video else n

    if video:
        write_video(output, pictures(), flight.frames_per_second, flight.panorama is not None)
    else:
        # The power of ten of which 65,535 steps reach between 8 and 80 scene depths far: millimetres in a room.
        unit = 10.0 ** np.ceil(np.log10(8.0 * run.record.scene_depth / 65535))
        write_pictures(output, pictures(), encoding or "tiff", unit, flight.panorama is not None)


def _exposures(run: FinishedRun) -> list[NDArray[np.float64]]:
    """Return the exposure of every recorded frame. Raises InputError if they are not available."""
    known = read_exposures(run.folder / "exposure.json")
    if not known:
        raise InputError(f"{run.folder}: no exposures were estimated (mapping.exposure.enabled): leave out --exposure")
    if missing := [index for index in run.way.tolist() if index not in known]:
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

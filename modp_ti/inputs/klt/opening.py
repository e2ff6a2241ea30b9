"""Opening of the tracker `klt`: checks the images, and estimates their camera if it is unknown."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.inputs.klt.camera import ADVICE, BEFORE_TRACKING, FOCAL_FROM, TYPICAL_FOCAL, Lens, estimation_note
from modp_ti.inputs.klt.odometry import Odometry
from modp_ti.inputs.klt.tracker import KltTracker, available, followed, grey_image, require_size
from modp_ti.inputs.opening import open_source, require_pinhole
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import readable_sizes
from modp_ti.inputs.sources import FrameReader, ImageSource, Intrinsics, require_intrinsics
from modp_ti.inputs.sources.image_header import focal_length_35mm

if TYPE_CHECKING:
    from modp_ti.inputs.readers.klt import KltSettings
    from modp_ti.inputs.source_settings import SourceSettings

CALIBRATION_FRAMES = 300
CALIBRATION_STRIDE = 3
DIAGONAL_35MM = 43.27  # mm
# Further keyframes change the estimate little.
ENOUGH = 60


def open_klt(
    source: SourceSettings,
    settings: KltSettings | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    images: ImageSource | None = None,
) -> KltTracker:
    """Open the images of a source and return a tracker for them.

    If the source has no intrinsics, they are estimated from its first images; the focal length in EXIF, or a typical
    one, is the initial value. Frames of a source that follows a clock do not wait for that: they are delivered with the
    initial value, and corrections bring the estimates.

    Args:
        source: Settings of the images.
        settings: Settings of the tracker, None for the defaults.
        seed: Seed of RANSAC.
        progress: Called during the estimation of the camera.
        images: The images, None to open those of the settings.

    Raises:
        InputError: If the images are missing, unreadable or of several sizes, or do not fit the intrinsics; or if loops
            are to be closed without `gtsam`.
    """
    loops = settings is not None and settings.loops
    if loops and find_spec("gtsam") is None:
        raise InputError(
            "tracker.loops needs gtsam (Linux and macOS, Python 3.11 or newer): pip install 'modp-ti[loops]'"
        )
    images = open_source(source) if images is None else images
    reader = FrameReader(images, source)
    first = next(images.arriving(source.start, source.stop, source.step), None)
    if first is None:
        raise InputError(f"{images.path}: brought no image")
    width, height = images.size(first)
    there = available(reader)
    for name, size in readable_sizes(images, there):
        require_size(images, name, size, (width, height))
    notes = []
    intrinsics = None if images.intrinsics is None else require_intrinsics(images)
    blank = Intrinsics(PinholeCamera(max(width, height), max(width, height), width / 2, height / 2, width, height))
    reader.require_fitting([(name, (intrinsics or blank).undistorter(1.0)) for name in there])
    if intrinsics is None and images.arrivals is None:
        require_pinhole(images, source, there[0])
    if intrinsics is None and images.arrivals is not None:
        intrinsics, note = _guessed(reader, blank)
        return KltTracker(reader, intrinsics, seed, [note], is_guess=True, loops=loops)
    if intrinsics is None:
        intrinsics, note = _estimated(reader, blank, seed, progress)
        notes.append(note)
    elif (intrinsics.camera.width, intrinsics.camera.height) != (width, height):
        raise InputError(
            f"{images.path / first} is {width}x{height}, the camera {intrinsics.camera.width}x"
            f"{intrinsics.camera.height}: give the intrinsics of the stored images"
        )
    return KltTracker(
        reader,
        intrinsics,
        seed,
        notes,
        loops=loops,
        place=None if settings is None else settings.place,
        further=settings is not None and settings.maps == "all",
        progress=progress,
    )


def _guessed(reader: FrameReader, blank: Intrinsics) -> tuple[Intrinsics, str]:
    """Guess the camera from EXIF, or take a typical one. Returns it with a note for the user."""
    width, height = blank.camera.width, blank.camera.height
    film = focal_length_35mm(reader.images.path / available(reader)[0])
    focal, origin = TYPICAL_FOCAL * max(width, height), "is a guess, for the images do not tell"
    if film is not None:
        focal, origin = film / DIAGONAL_35MM * float(np.hypot(width, height)), "is what EXIF says"
    camera = PinholeCamera(focal, focal, width / 2, height / 2, width, height)
    return Intrinsics(camera), f"the camera is not known: focal length {focal:.1f} px {origin}; {ADVICE}"


def _estimated(reader: FrameReader, blank: Intrinsics, seed: int, progress: Progress | None) -> tuple[Intrinsics, str]:
    """Estimate the camera from EXIF and the images. Returns it with a note for the user."""
    there, undistorter = available(reader), followed(blank)
    guess, note = _guessed(reader, blank)
    stride = int(np.clip(len(there) // CALIBRATION_FRAMES, 1, CALIBRATION_STRIDE))
    images = (grey_image(reader, name, undistorter)[1:] for name in there[: stride * CALIBRATION_FRAMES : stride])
    total = min(CALIBRATION_FRAMES, len(there))
    size = blank.camera.width, blank.camera.height
    found, used = estimated_intrinsics(images, size, guess.camera.fx, seed, progress, total)
    return (guess, note) if found is None else (found, estimation_note(found, used))


def estimated_intrinsics(
    images: Iterable[tuple[NDArray[np.uint8], NDArray[np.bool_] | None]],
    size: tuple[int, int],
    start: float,
    seed: int,
    progress: Progress | None,
    total: int,
    enough: int = ENOUGH,
) -> tuple[Intrinsics | None, int]:
    """Estimate one focal length and one radial distortion coefficient; the principal point is the image centre.

    The images are tracked with the initial focal length. Then the map and the camera are bundle adjusted together.

    Args:
        images: Grey images (H, W) uint8 with masks of the usable pixels. All have one size, with the aspect ratio of
            the stored images.
        size: (width, height) of the stored images.
        start: Initial focal length [px of the stored images].
        seed: Seed of RANSAC.
        progress: Called after each image.
        total: Number of images to report to `progress`.
        enough: Number of keyframes after which no further images are used.

    Returns:
        The camera of the stored images, or None if it cannot be estimated; and the number of images used.
    """
    odometry, used = None, 0
    for grey, valid in images:
        if odometry is None:
            scale = grey.shape[1] / size[0]
            lens = Lens.radial(start * scale, 0.0, grey.shape[1], grey.shape[0])
            odometry = Odometry(lens, seed, BEFORE_TRACKING)
        odometry.process(used, grey, valid)
        used += 1
        if progress is not None:
            progress("estimating the camera", min(used, total - 1), total)
        if odometry.tracking is not None and len(odometry.tracking.map.keyframes) >= enough:
            break
    if progress is not None:
        progress("estimating the camera", total, total)
    tracking = None if odometry is None else odometry.tracking
    if tracking is None or len(tracking.map.keyframes) < FOCAL_FROM:
        return None, used
    tracking.refine_camera()
    lens = tracking.map.lens
    return (lens.intrinsics(*size) if lens.is_plausible else None), used

"""Provides the images of a finished run, either those that it kept or read again from the scene's source."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray

from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError
from modp_ti.inputs.trackers import open_tracker
from modp_ti.outputs.formats.colmap_model import image_names, write_image
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.progress import ProgressLine

__all__ = ["dataset_names", "grey_images", "write_images"]


def dataset_names(run: FinishedRun) -> list[str]:
    """Return the PNG names of the run's images in a data set, by position."""
    return run.names if _kept(run).is_dir() else image_names(run.names, written=True)


def write_images(run: FinishedRun, folder: Path, line: ProgressLine) -> None:
    """Write all undistorted images to `images`, and the masks to `masks`, in a folder.

    If the run did not keep its images (`export.images`), they are read again from the scene's source, for which the
    tracker `klt` has to track again.

    Args:
        run: The finished run.
        folder: The folder to write to.
        line: Shows the progress.

    Raises:
        InputError: If the source is gone, was live, or now delivers other frames.
    """
    names = dataset_names(run)
    if _kept(run).is_dir():
        for name in line.through("copying images", names, len(names)):
            if not (_kept(run) / name).is_file():
                raise InputError(f"{_kept(run) / name}: the run's image is missing")
            for copied in (f"images/{name}", f"masks/{name}.png"):
                if (run.folder / "colmap" / copied).is_file():
                    (folder / copied).parent.mkdir(parents=True, exist_ok=True)
                    shutil.copyfile(run.folder / "colmap" / copied, folder / copied)
        return
    config = load_scene(run.folder / "config.yaml")
    if config.is_live or config.source.realtime:
        raise InputError(
            f"{run.folder}: its frames were live and cannot be read again; such a run needs `export.images: true`"
        )
    tracker = open_tracker(config.without_clock(), line.prepare)
    other = InputError(
        f"{config.source.path or run.folder}: the source no longer gives the frames that were mapped; run the scene "
        "again, with `export.images: true` to keep them"
    )
    try:
        count = 0
        for frame in line.through("reading images", tracker, len(run)):
            i = frame.index
            if i >= len(run) or (frame.name, frame.camera) != (run.names[i], run.cameras[i]):
                raise other
            write_image(folder, names[i], frame)
            count += 1
        if count < len(run):
            raise other
    finally:
        tracker.close()


def grey_images(run: FinishedRun, positions: Sequence[int], line: ProgressLine) -> list[NDArray[np.uint8]]:
    """Return the grey images (H, W) of some frames.

    Args:
        run: The finished run.
        positions: Positions of the frames.
        line: Shows the progress.

    Raises:
        InputError: As `write_images`.
    """
    names = dataset_names(run)
    with TemporaryDirectory() as folder:
        place = _kept(run)
        if not place.is_dir():
            write_images(run, Path(folder), line)
            place = Path(folder) / "images"
        images = []
        for index in positions:
            image = cv2.imread(str(place / names[index]), cv2.IMREAD_GRAYSCALE)
            if image is None:
                raise InputError(f"{place / names[index]}: the run's image is missing")
            images.append(image)
    return images


def _kept(run: FinishedRun) -> Path:
    return run.folder / "colmap" / "images"

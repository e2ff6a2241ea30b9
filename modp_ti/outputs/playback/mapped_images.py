"""Provides the images of a finished run, either those that it kept or read again from the scene's source."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.dataset import image_names, write_image
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.run_pictures import kept_images, pictures
from modp_ti.outputs.progress import ProgressLine


def dataset_names(run: FinishedRun) -> list[str]:
    """Return the PNG names of the run's images in a data set, by position."""
    return run.names if kept_images(run) is not None else image_names(run.names, written=True)


def write_images(run: FinishedRun, folder: Path, line: ProgressLine) -> None:
    """Write all undistorted images to `images`, and the masks to `masks`, in a folder.

    If the run did not keep its images (`export.images`), they are read again from the scene's source.

    Args:
        run: The finished run.
        folder: The folder to write to.
        line: Shows the progress.

    Raises:
        InputError: If the source is gone, was live, or now delivers other frames.
    """
    names, kept = dataset_names(run), kept_images(run)
    if kept is None:
        for name, picture in zip(
            names, line.through("reading images", pictures(run, line.prepare), len(run)), strict=True
        ):
            write_image(folder, name, picture)
        return
    for name in line.through("copying images", names, len(names)):
        if not (kept / name).is_file():
            raise InputError(f"{kept / name}: the run's image is missing")
        for copied in (f"images/{name}", f"masks/{name}.png"):
            if (run.folder / "colmap" / copied).is_file():
                (folder / copied).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(run.folder / "colmap" / copied, folder / copied)


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
        place = kept_images(run)
        if place is None:
            write_images(run, Path(folder), line)
            place = Path(folder) / "images"
        images = []
        for index in positions:
            image = cv2.imread(str(place / names[index]), cv2.IMREAD_GRAYSCALE)
            if image is None:
                raise InputError(f"{place / names[index]}: the run's image is missing")
            images.append(image)
    return images

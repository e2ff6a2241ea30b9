"""The pictures of a finished run in the order of its frames: those that it kept, or read again from its source."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from fields.geometry.camera import PinholeCamera
from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_source, open_tracker
from modp_ti.inputs.readers.transforms import TransformsSettings, masks_of_transforms
from modp_ti.inputs.sources import FrameReader, Picture, Undistorter
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.outputs.playback.finished_run import FinishedRun, open_run

Preparing = Callable[[str, int, int], None]


def kept_images(run: FinishedRun) -> Path | None:
    """Return the folder of the undistorted images that the run kept (`export.images`), or None."""
    folder = run.folder / "colmap" / "images"
    return folder if folder.is_dir() else None


def run_settings(run: FinishedRun) -> SceneConfig:
    """Return the settings of the run. Raises InputError if they cannot be read."""
    return load_scene(run.folder / "config.yaml")


def pictures(
    run: FinishedRun, preparing: Preparing | None = None, wanted: Sequence[int] | None = None
) -> Generator[Picture]:
    """Yield the undistorted picture of every frame. Kept images have no vignette.

    Args:
        run: The finished run.
        preparing: Called while a tracker prepares, where the images have to be read through it.
        wanted: Ascending positions of the frames whose pictures to yield; None for all.

    Raises:
        InputError: If the images are gone, were live and not kept, or are others than those that were mapped.
    """
    folder, wanted = kept_images(run), range(len(run)) if wanted is None else wanted
    if folder is not None:
        yield from (_kept(folder, run.names[place], run.cameras[place]) for place in wanted)
        return
    config = run_settings(run)
    if config.is_live or config.source.realtime:
        raise InputError(
            f"{run.folder}: its frames were live and cannot be read again; such a run needs `export.images: true`"
        )
    own = _Frames(run.names, run.cameras)
    if config.onto is not None:  # the frames of an earlier run come first, in names that say so from the second on
        first = open_run(config.onto)
        if len(first) >= len(run) or first.cameras != run.cameras[: len(first)]:
            raise InputError(f"{config.onto}: it is no longer the run that {run.folder} goes on with; map both again")
        yield from pictures(first, preparing, [place for place in wanted if place < len(first)])
        names = [name.partition("/")[2] for name in run.names[len(first) :]]
        own = _Frames(names, run.cameras[len(first) :])
        wanted = [place - len(first) for place in wanted if place >= len(first)]
    yield from _read_again(config, own, wanted, run.record.stored_camera, preparing)


@dataclass(frozen=True)
class _Frames:
    """Names in the source, and cameras, of the frames of one recording."""

    names: Sequence[str]
    cameras: Sequence[PinholeCamera]


def _kept(folder: Path, name: str, camera: PinholeCamera) -> Picture:
    file = folder / name
    image = cv2.imread(str(file), cv2.IMREAD_COLOR_RGB) if file.is_file() else None
    if image is None:
        raise InputError(f"{file}: the run's image is missing")
    mask = folder.with_name("masks") / f"{name}.png"
    valid = None
    if mask.is_file():
        stored = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)
        if stored is None or stored.shape != image.shape[:2]:
            raise InputError(f"{mask}: not the mask of {name}")
        valid = stored > 0
    return Picture(np.divide(image, np.float32(255.0), dtype=np.float32), valid, None, camera)


def _read_again(
    config: SceneConfig,
    frames: _Frames,
    wanted: Sequence[int],
    stored: Intrinsics | None,
    preparing: Preparing | None,
) -> Generator[Picture]:
    """Read frames from the source: by the camera that the run recorded, or through the tracker if it has several."""
    scale = config.source.scale
    undistorter = None if stored is None or scale == "auto" else stored.undistorter(scale)
    if undistorter is not None and set(frames.cameras) == {undistorter.camera}:
        yield from _through_source(config, [frames.names[place] for place in wanted], undistorter)
        return
    with closing(open_tracker(config.without_clock(), preparing)) as tracker:
        found = tracker.pictures([frames.names[place] for place in wanted])
        for place in wanted:
            name, picture = next(found, (None, None))
            if picture is None or (name, picture.camera) != (frames.names[place], frames.cameras[place]):
                raise _changed(config)
            yield picture


def _through_source(config: SceneConfig, names: Sequence[str], undistorter: Undistorter) -> Generator[Picture]:
    with closing(open_source(config.without_clock().source)) as images:
        source, tracker = config.source, config.tracker
        masks = masks_of_transforms(images, source, tracker) if isinstance(tracker, TransformsSettings) else None
        reader, there = FrameReader(images, source, masks), set(images.selected(source.start, source.stop, source.step))
        for name in names:
            if name not in there or images.size(name) != (undistorter.raw.width, undistorter.raw.height):
                raise _changed(config)
            yield reader.read(name, undistorter)


def _changed(config: SceneConfig) -> InputError:
    return InputError(
        f"{config.source.path}: the source no longer gives the frames that were mapped; run the scene again, with "
        "`export.images: true` to keep them"
    )

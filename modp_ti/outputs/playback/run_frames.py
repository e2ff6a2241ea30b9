"""The frames of a finished run: the images that it kept or that its source gives again, at their refined poses."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from fields.frames.origin import shifted
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.inputs.colmap_model import read_colmap_model
from modp_ti.inputs.opening import open_source, open_tracker
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.readers.transforms import TransformsSettings, masks_of_transforms
from modp_ti.inputs.sources import FrameReader, Picture
from modp_ti.inputs.sources.undistortion import Intrinsics
from modp_ti.outputs.playback.finished_run import FinishedRun, open_run


def kept_images(run: FinishedRun) -> Path | None:
    """Return the folder of the undistorted images that the run kept (`export.images`), or None."""
    folder = run.folder / "colmap" / "images"
    return folder if folder.is_dir() else None


def run_settings(run: FinishedRun) -> SceneConfig:
    """Return the settings of the run. Raises InputError if they cannot be read."""
    return load_scene(run.folder / "config.yaml")


def pictures(
    run: FinishedRun, places: Sequence[int] | None = None, preparing: Progress | None = None
) -> Generator[Picture]:
    """Yield the undistorted pictures of frames. Kept images have no vignette.

    Args:
        run: The finished run.
        places: Ascending positions of the frames; None for all.
        preparing: Called while a tracker prepares, where the images have to be read through it.

    Raises:
        InputError: If the images are gone, were live and not kept, or are others than those that were mapped.
    """
    folder, places = kept_images(run), range(len(run)) if places is None else places
    if folder is not None:
        yield from (_kept(folder, run.names[place], run.cameras[place]) for place in places)
        return
    config = run_settings(run)
    if config.is_live or config.source.realtime:
        raise InputError(
            f"{run.folder}: its frames were live and cannot be read again; such a run needs `export.images: true`"
        )
    names, first = run.names, 0
    if config.onto is not None:  # the frames of an earlier run come first; the names of the others get a prefix
        earlier = open_run(config.onto)
        first = len(earlier)
        if first >= len(run) or earlier.cameras != run.cameras[:first]:
            raise InputError(f"{config.onto}: it is no longer the run that {run.folder} goes on with; map both again")
        yield from pictures(earlier, [place for place in places if place < first], preparing)
        names = [name.partition("/")[2] for name in names]
    wanted = [(names[place], run.cameras[place]) for place in places if place >= first]
    of_one_camera = len(set(run.cameras[first:])) == 1
    yield from _read_again(config, wanted, run.record.stored_camera if of_one_camera else None, preparing)


def _kept(folder: Path, name: str, camera: PinholeCamera) -> Picture:
    file, mask = folder / name, folder.with_name("masks") / f"{name}.png"
    image = cv2.imread(str(file), cv2.IMREAD_COLOR_RGB) if file.is_file() else None
    if image is None or image.shape[:2] != (camera.height, camera.width):
        raise InputError(f"{file}: the run's image is missing, or of another size than its camera")
    valid = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE) if mask.is_file() else None
    if mask.is_file() and (valid is None or valid.shape != image.shape[:2]):
        raise InputError(f"{mask}: not the mask of {name}")
    colours = np.divide(image, np.float32(255.0), dtype=np.float32)
    return Picture(colours, None if valid is None else valid > 0, None, camera)


def _read_again(
    config: SceneConfig,
    wanted: Sequence[tuple[str, PinholeCamera]],
    stored: Intrinsics | None,
    preparing: Progress | None,
) -> Generator[Picture]:
    """Read images from the source: by the camera that the run recorded, or through the tracker if it has several."""
    config = config.without_clock()
    source, tracker = config.source, config.tracker
    undistorter = None if stored is None or source.scale == "auto" else stored.undistorter(source.scale)
    changed = InputError(
        f"{source.path}: the source no longer gives the frames that were mapped; run the scene again, with "
        "`export.images: true` to keep them"
    )
    if undistorter is not None and all(camera == undistorter.camera for _, camera in wanted):
        with closing(open_source(source)) as images:
            masks = masks_of_transforms(images, source, tracker) if isinstance(tracker, TransformsSettings) else None
            reader = FrameReader(images, source, masks)
            there = set(images.selected(source.start, source.stop, source.step))
            for name, _ in wanted:
                if name not in there or images.size(name) != (undistorter.raw.width, undistorter.raw.height):
                    raise changed
                yield reader.read(name, undistorter)
        return
    with closing(open_tracker(config, preparing)) as opened:
        found = opened.pictures([name for name, _ in wanted])
        for name, camera in wanted:
            there, picture = next(found, (None, None))
            if picture is None or (there, picture.camera) != (name, camera):
                raise changed
            yield picture


def frames_of(run: FinishedRun, places: Sequence[int], preparing: Progress | None = None) -> Generator[TrackedFrame]:
    """Yield frames of a finished run with their refined poses in coordinates from the map's origin, without points.

    Args:
        run: The finished run.
        places: Ascending positions of the frames.
        preparing: Called while a tracker prepares, where the images have to be read through it.

    Raises:
        InputError: As `pictures`.
    """
    held_out = set(run.record.held_out)
    with closing(pictures(run, places, preparing)) as images:
        for place, picture in zip(places, images, strict=True):
            time, name = float(run.timestamps[place]), run.names[place]
            yield TrackedFrame(
                place, time, name, T_camera_world=run.poses[place], held_out=place in held_out, **vars(picture)
            )


class FinishedFrames:
    """The frames of a finished run in its world. Images are read one by one.

    The ids of the points are negative, so that they never are those of another tracker.

    Args:
        run: The finished run.
        preparing: Called while a tracker prepares, where the images have to be read through it.

    Raises:
        InputError: If the run's COLMAP model is damaged.
    """

    def __init__(self, run: FinishedRun, preparing: Progress | None = None) -> None:
        self._run = run
        self._preparing = preparing
        model = read_colmap_model(run.folder / "colmap")
        self._points = []
        for number, camera in zip(sorted(model.images), run.cameras, strict=True):
            image = model.images[number]
            inside = camera.contains(image.pixels)
            ids = image.ids[inside]
            self._points.append(SparsePoints(model.positions(ids), image.pixels[inside], -ids))

    def __len__(self) -> int:
        return len(self._run)

    @property
    def size(self) -> tuple[int, int]:
        """Largest width and height of the images [px]."""
        return self._run.size

    @property
    def end(self) -> float:
        """Time of the last frame [s]."""
        return float(self._run.timestamps.max())

    def pictures(self, names: Sequence[str]) -> Iterator[tuple[str, Picture]]:
        """Read images again, see `Tracker.pictures`."""
        wanted = set(names)
        places = [place for place, name in enumerate(self._run.names) if name in wanted]
        for place, picture in zip(places, pictures(self._run, places, self._preparing), strict=True):
            yield self._run.names[place], picture

    def __iter__(self) -> Iterator[TrackedFrame]:
        for frame in frames_of(self._run, range(len(self._run)), self._preparing):
            yield replace(shifted(frame, self._run.record.origin), points=self._points[frame.index])

"""`FinishedFrames`: the frames of a finished run as a mapper takes them, with their refined poses."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import replace

from fields.frames.origin import shifted
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from modp_ti.inputs.colmap_model import read_colmap_model
from modp_ti.inputs.frame_record import FrameRecord
from modp_ti.inputs.sources import Picture
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.run_pictures import Preparing, pictures


class FinishedFrames:
    """The frames of a finished run in its world. Images are read one by one.

    The ids of the points are negative, so that they never are those of another tracker.

    Args:
        run: The finished run.
        preparing: Called while a tracker prepares, where the images have to be read through it.

    Raises:
        InputError: If the run's COLMAP model is damaged.
    """

    def __init__(self, run: FinishedRun, preparing: Preparing | None = None) -> None:
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
        for place, picture in zip(places, pictures(self._run, self._preparing, places), strict=True):
            yield self._run.names[place], picture

    def __iter__(self) -> Iterator[TrackedFrame]:
        for frame in frames_of(self._run, range(len(self._run)), self._preparing):
            yield replace(shifted(frame, self._run.record.origin), points=self._points[frame.index])


def frames_of(run: FinishedRun, places: Sequence[int], preparing: Preparing | None = None) -> Generator[TrackedFrame]:
    """Yield frames of a finished run with their refined poses in coordinates from the map's origin, without points.

    Args:
        run: The finished run.
        places: Ascending positions of the frames.
        preparing: Called while a tracker prepares, where the images have to be read through it.

    Raises:
        InputError: As `pictures`.
    """
    held_out = set(run.record.held_out)
    with closing(pictures(run, preparing, places)) as images:
        for place, picture in zip(places, images, strict=True):
            time, name = float(run.timestamps[place]), run.names[place]
            record = FrameRecord(place, time, name, run.poses[place], SparsePoints(), place in held_out)
            yield record.with_picture(picture)

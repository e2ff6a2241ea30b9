"""The `ImageSource` base class."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.files.terminal import require_text
from modp_ti.inputs.sources.orientation import AS_STORED, Turn
from modp_ti.inputs.sources.undistortion import Intrinsics

if TYPE_CHECKING:
    from modp_ti.inputs.capture import Capture
    from modp_ti.inputs.sources.backlog import Arrivals
    from modp_ti.inputs.sources.paced import Pace

IMAGE_SUFFIXES = (
    *(".jpg", ".jpeg", ".jfif", ".jpe", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm", ".jp2"),
    *(".heic", ".heif", ".hif", ".avif"),
)


class ImageSource(ABC):
    """Base class of image sources: images by name, in the order in which they were taken, decoded on demand.

    Args:
        path: Location of the images.
        names: Names of the images that are known at the start, in order.
        times: Time of each of them [s].

    Attributes:
        path: Location of the images, for messages.
        intrinsics: Camera of the stored images, from the user or else from the source. None if unknown.
        vignette: Share of the light (H, W, 3) float32, at most 1, that reaches each part of the stored image's field of
            view. None if unknown.
        capture: Poses and depth maps that come with the images. None if none do.
        T_device_camera: Pose (4, 4) of the camera on a device with other sensors, camera to device, OpenCV axes. None
            for a camera alone.
        scale: Factor from the stored images' width and height to those of the frames, as `source.scale` says.
        pace: By what the images of a recording arrive, if not when they are asked for.
    """

    def __init__(self, path: Path, names: Iterable[str] = (), times: Iterable[float] = ()) -> None:
        self.path = path
        self.intrinsics: Intrinsics | None = None
        self.vignette: NDArray[np.float32] | None = None
        self.capture: Capture | None = None
        self.T_device_camera: NDArray[np.float64] | None = None
        self.scale = 1.0
        self.pace: Pace | None = None
        self._size: tuple[int, int] | None = None  # (width, height) of every image, where they have one size
        self._notes: list[str] = []
        self._names: list[str] = []
        self._times: list[float] = []
        self._position: dict[str, int] = {}
        for name, time in zip(names, times, strict=True):
            self._append(name, time)

    def _append(self, name: str, time: float) -> None:
        """Add an image and the time at which it was taken [s]. Live sources do so while they run."""
        require_text(name)
        self._times.append(float(time))
        self._position[name] = len(self._names)
        self._names.append(name)

    @property
    def notes(self) -> list[str]:
        """One-line remarks for the user. A live source may add more by its end."""
        return self._notes if self.pace is None else [*self._notes, *self.pace.notes(self.path)]

    @property
    def ending(self) -> str | None:
        """Why the recording of a live source ended, None if it was asked to or has not."""
        return None

    def add_note(self, note: str, first: bool = False) -> None:
        """Add a remark after the others, or before them if `first`."""
        self._notes.insert(0 if first else len(self._notes), note)

    @property
    def names(self) -> Sequence[str]:
        """Names of all images, in order. The names of a live source grow while it runs."""
        return self._names

    def __len__(self) -> int:
        return len(self.names)

    @property
    def whole(self) -> ImageSource:
        """The source of the images that poses are of: this one, but that of the panoramas for faces cut from them."""
        return self

    @property
    def mounts(self) -> Sequence[NDArray[np.float64]]:
        """Poses T_view_rig (4, 4) of the views that each image of `whole` gives."""
        return [np.eye(4)]

    def views(self, name: str) -> Sequence[str]:
        """Return the names of the views that the image `name` of `whole` gives."""
        return [name]

    def position(self, name: str) -> int:
        """Return the position of an image in `names`, from 0."""
        return self._position[name]

    def timestamp(self, name: str) -> float:
        """Return the time at which the image was taken [s]."""
        return self._times[self._position[name]]

    def find(self, name: str) -> str | None:
        """Find the image that a tracker's file name refers to, or return None. Folders and image suffix are ignored.

        This is for sources that name their frames themselves. A number alone does not match, because programs that
        extract frames differ in counting from 0 or from 1.
        """
        path = PurePosixPath(name.replace("\\", "/"))
        tail = path.stem if path.suffix.lower() in IMAGE_SUFFIXES else path.name
        return tail if tail in self._position else None

    def find_all(self, names: Sequence[str]) -> tuple[list[str | None], str | None]:
        """Find the images that all file names of a tracker refer to.

        Programs that extract frames count them from 1, this source from 0. Names that are one off only then show it
        where the last one lies beyond the end; all of them are then shifted.

        Returns:
            The image of each name, None where there is none; and a remark if they are not named as here.
        """
        found = [self.find(name) for name in names]
        if None in found and any(found):
            shifted = [self.find(_one_less(name)) for name in names]
            if None not in shifted:
                return shifted, f"its names count from 1, those of {self.path.name} from 0: {names[0]} is {shifted[0]}"
        return found, None

    def selected(self, start: int, stop: int | None, step: int) -> Sequence[str]:
        """Return the names at positions start, start + step, ... before stop.

        Raises:
            InputError: If there are none.
        """
        names = self._names[start:stop:step]
        if not names:
            raise InputError(
                f"{self.path}: source.start={start} leaves no frame of the {len(self)} "
                f"in the {'folder' if self.path.is_dir() else 'file'}"
            )
        return names

    def arriving(self, start: int, stop: int | None, step: int) -> Iterator[str]:
        """Yield the names of `selected` as soon as their images are available. Ends when no more will come."""
        names = self.selected(start, stop, step)
        return iter(names) if self.pace is None else self.pace.arriving(names, [*map(self.timestamp, names)])

    def finish(self) -> None:
        """End the recording of a source that follows a clock. Images that have arrived are still delivered."""
        if self.pace is not None:
            self.pace.finish()

    @property
    def recording(self) -> bool:
        """Whether images still arrive at a source that follows a clock, so that `finish` has an effect."""
        return self.pace is not None and self.pace.recording

    @property
    def kept(self) -> dict[str, dict[str, str | None]]:
        """As `Tracker.kept`."""
        return {}

    @property
    def arrivals(self) -> Arrivals | None:
        """Number of images received so far; None for a source that follows no clock."""
        return None if self.pace is None else self.pace.arrivals

    def arrived(self, name: str) -> float | None:
        """Return `time.monotonic()` when a delivered image was received [s]; None if the source follows no clock."""
        return None if self.pace is None else self.pace.arrived(name)

    @property
    def frame_size(self) -> tuple[int, int]:
        """Size (width, height) of the first image. A live source knows it before it has delivered any."""
        return self._size or self.size(self.names[0])

    def size(self, name: str) -> tuple[int, int]:
        """Return the size (width, height) of the stored image.

        Raises:
            InputError: If the image is unreadable.
        """
        assert self._size is not None and name in self._position, name
        return self._size

    def turn(self, name: str) -> Turn:
        """Return how the stored image is turned before it is delivered. `size` and `read` give the turned image."""
        return AS_STORED

    @abstractmethod
    def read(self, name: str) -> NDArray[np.uint8]:
        """Decode the stored image (H, W, 3) uint8 RGB.

        This may be called for any image that has arrived, repeatedly, and from one other thread.

        Raises:
            InputError: If the image is unreadable.
        """

    def valid(self, name: str) -> NDArray[np.bool_] | None:
        """Return the validity mask (H, W) that comes with the image itself, or None."""
        return None

    def close(self) -> None:  # noqa: B027 - most sources hold nothing open
        """Release open resources, such as a camera or a file."""


def _one_less(name: str) -> str:
    """Return a name with the number at its end lowered by one."""
    return re.sub(r"[0-9]+(?=[^0-9]*$)", lambda n: f"{int(n[0]) - 1:0{len(n[0])}d}", name)


def require_intrinsics(images: ImageSource) -> Intrinsics:
    """Return the camera of the source, for trackers that do not provide one.

    The note of the intrinsics is added to the notes of the source.

    Raises:
        InputError: If the camera is unknown.
    """
    if images.intrinsics is None:
        raise InputError(
            f"{images.path}: the camera is not known: give source.intrinsics: {{fx: ..., fy: ..., cx: ..., cy: ...}} "
            "in pixels of the stored images"
        )
    if images.intrinsics.note is not None:
        images.add_note(images.intrinsics.note)
    return images.intrinsics

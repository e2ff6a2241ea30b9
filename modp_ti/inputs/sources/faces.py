"""`PanoramaFaces`: the pinhole faces of panoramas as images of a source."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from modp_ti.config.camera_settings import PanoramaSettings
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.sources.intrinsics import Intrinsics
from modp_ti.inputs.sources.panorama import Face, faces_of, projection_of
from modp_ti.inputs.sources.protocol import ImageSource

# Pixels that the panorama is continued by beyond its edges, for the cubic filter.
MARGIN = 4


class PanoramaFaces(ImageSource):
    """Cuts each image of a source into faces, which follow one another as images of one time.

    The last panorama stays decoded, since its faces are read one after the other.

    Args:
        whole: Source of the panoramas, all of one size.
        settings: Settings of the projection and of the faces.

    Raises:
        InputError: If the first readable image is not twice as wide as high, or none is readable.
    """

    def __init__(self, whole: ImageSource, settings: PanoramaSettings) -> None:
        super().__init__(whole.path)
        self._whole = whole
        first, size = _first_readable(whole)
        self._projection = projection_of(settings, *size, f"{whole.path / first}")
        self._faces = faces_of(settings, self._projection)
        camera = self._faces[0].camera
        self.intrinsics = Intrinsics(camera)
        self._size = camera.width, camera.height
        self._decoded: tuple[str, NDArray[np.uint8]] | None = None
        self._face: dict[str, tuple[str, int]] = {}  # panorama and number of the face, by name
        for name in whole.names:
            for number in range(len(self._faces)):
                face = _face_name(name, number)
                self._append(face, whole.timestamp(name))
                self._face[face] = name, number
        sides = f"{len(self._faces)} faces of {camera.width}x{camera.height}"
        self.add_note(f"{whole.path}: each of its {len(whole)} panoramas is cut into {sides}")

    @property
    def notes(self) -> list[str]:
        return [*self._whole.notes, *self._notes]

    @property
    def whole(self) -> ImageSource:
        return self._whole

    @property
    def mounts(self) -> Sequence[NDArray[np.float64]]:
        return [face.T_face_rig for face in self._faces]

    def views(self, name: str) -> list[str]:
        return [_face_name(name, number) for number in range(len(self._faces))]

    def selected(self, start: int, stop: int | None, step: int) -> Sequence[str]:
        return [face for name in self._whole.selected(start, stop, step) for face in self.views(name)]

    def arriving(self, start: int, stop: int | None, step: int) -> Iterator[str]:
        return iter(self.selected(start, stop, step))

    def read(self, name: str) -> NDArray[np.uint8]:
        import cv2

        panorama, number = self._face[name]
        x, y, _ = self._lookups[number]
        face = cv2.remap(self._continued(panorama), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(face, np.uint8)

    def valid(self, name: str) -> NDArray[np.bool_] | None:
        return self._lookups[self._face[name][1]][2]

    def close(self) -> None:
        self._whole.close()

    def _continued(self, name: str) -> NDArray[np.uint8]:
        """The panorama (H + 2 MARGIN, W + 2 MARGIN, 3), of which an equirectangular one goes on at its other side."""
        import cv2

        if self._decoded is None or self._decoded[0] != name:
            image, projection = self._whole.read(name), self._projection
            if image.shape[:2] != (projection.height, projection.width):
                raise InputError(
                    f"{self.path / name} is {image.shape[1]}x{image.shape[0]}, the first panorama {projection.width}x"
                    f"{projection.height}: all panoramas of a scene must have one size"
                )
            aside = cv2.BORDER_WRAP if projection.lens_fov is None else cv2.BORDER_REPLICATE
            image = cv2.copyMakeBorder(image, 0, 0, MARGIN, MARGIN, aside)
            image = cv2.copyMakeBorder(image, MARGIN, MARGIN, 0, 0, cv2.BORDER_REPLICATE)
            self._decoded = name, np.asarray(image, np.uint8)
        return self._decoded[1]

    @cached_property
    def _lookups(self) -> list[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_] | None]]:
        """For each face, its lookup maps x and y (H, W) into the continued panorama, and the pixels that it has."""
        return [self._lookup(face) for face in self._faces]

    def _lookup(self, face: Face) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_] | None]:
        pixels = self._projection.pixels(face.rays())
        seen = np.asarray(np.isfinite(pixels).all(axis=-1))
        seen.flags.writeable = False
        lookup = np.where(seen[..., None], pixels - 0.5 + MARGIN, 0.0).astype(np.float32)
        x, y = np.ascontiguousarray(lookup[..., 0]), np.ascontiguousarray(lookup[..., 1])
        return x, y, None if seen.all() else seen


def _first_readable(images: ImageSource) -> tuple[str, tuple[int, int]]:
    """Name and size (width, height) of the first readable image. Raises the first one's error if there is none."""
    error: UnreadableImageError | None = None
    for name in images.names:
        try:
            return name, images.size(name)
        except UnreadableImageError as found:
            error = error or found
    assert error is not None, "sources have images"
    raise error


def _face_name(name: str, number: int) -> str:
    path = PurePosixPath(name)
    return str(path.with_name(f"{path.stem}-face{number}{path.suffix}"))

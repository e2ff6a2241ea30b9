"""EXIF orientations: how stored images are turned upright, and cameras, poses and pixels with them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.sources.distortion import Distortion
from modp_ti.inputs.sources.image_header import ImageHeader


@dataclass(frozen=True)
class Turn:
    """The way from a stored image to the upright one: mirrored left to right first, then turned clockwise.

    Attributes:
        quarters: Quarter turns clockwise, 0 to 3.
        mirrored: Whether the image is mirrored first.
    """

    quarters: int = 0
    mirrored: bool = False

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Return the size (width, height) of the turned image."""
        return (height, width) if self.quarters % 2 else (width, height)

    def image(self, stored: NDArray[Any]) -> NDArray[Any]:
        """Turn an image (H, W, ...)."""
        if self == AS_STORED:
            return stored
        return np.ascontiguousarray(np.rot90(stored[:, ::-1] if self.mirrored else stored, -self.quarters))

    def stored(self, turned: NDArray[Any]) -> NDArray[Any]:
        """Undo the turn of an image (H, W, ...)."""
        back = np.rot90(turned, self.quarters)
        return back[:, ::-1] if self.mirrored else back

    def pixels(self, stored: NDArray[np.float64], width: int, height: int) -> NDArray[np.float64]:
        """Map pixels (N, 2) of a stored image of `width` x `height` to those of the image turned without mirroring."""
        x, y = stored[:, 0], stored[:, 1]
        for _ in range(self.quarters):
            x, y, width, height = height - y, x, height, width
        return np.stack([x, y], axis=1)

    def camera(self, stored: PinholeCamera, lens: Distortion) -> tuple[PinholeCamera, Distortion]:
        """Return the camera, with its lens, of images turned without mirroring."""
        for _ in range(self.quarters):
            stored = PinholeCamera(
                stored.fy, stored.fx, stored.height - stored.cy, stored.cx, stored.height, stored.width
            )
            # With (x, y) -> (-y, x), the pair (p2, p1), by which the tangential part is linear, turns as a vector.
            lens = replace(lens, tangential=(lens.tangential[1], -lens.tangential[0]))
        return stored, lens

    @property
    def T_turned_stored(self) -> NDArray[np.float64]:  # noqa: N802  # a transform is named by its ends
        """(4, 4) from the axes of the stored image's camera to those of the image turned without mirroring."""
        quarter = np.eye(4)
        quarter[:2, :2] = (0.0, -1.0), (1.0, 0.0)
        return np.linalg.matrix_power(quarter, self.quarters)

    def __str__(self) -> str:
        turned = f"turned clockwise by {90 * self.quarters} degrees" if self.quarters else ""
        return " and ".join(filter(None, ["mirrored" if self.mirrored else "", turned])) or "kept as they are stored"


AS_STORED = Turn()

# By the value of EXIF's tag Orientation.
_TURNS = {
    1: AS_STORED,
    2: Turn(0, mirrored=True),
    3: Turn(2),
    4: Turn(2, mirrored=True),
    5: Turn(3, mirrored=True),
    6: Turn(1),
    7: Turn(1, mirrored=True),
    8: Turn(3),
}


def turn_of_exif(orientation: int) -> Turn:
    """Return the turn of a value of EXIF's tag Orientation; unknown values keep the image as it is stored."""
    return _TURNS.get(orientation, AS_STORED)


def turns_of(headers: Mapping[str, ImageHeader]) -> tuple[dict[str, Turn], str | None]:
    """Decide how each image of a recording is turned.

    Images of one stored size are taken to be of one camera, and are all turned as the first one says: a phone that
    looks down decides at random which way is up, and the camera must not roll by 90 degrees between two frames. Images
    of several sizes are turned one by one.

    Args:
        headers: Header of each readable image by name, in order.

    Returns:
        The turn of each image that is not kept as it is stored, by name, and a remark for the user if an image asks to
        be turned.
    """
    stated = {name: turn_of_exif(header.orientation) for name, header in headers.items()}
    asking = {name: turn for name, turn in stated.items() if turn != AS_STORED}
    if not asking:
        return {}, None
    about = "intrinsics and masks are for the images as they are then"
    first = next(iter(stated.values()))
    one_size = len({(header.width, header.height) for header in headers.values()}) == 1
    if one_size and len(set(stated.values())) > 1:
        turns = {} if first == AS_STORED else dict.fromkeys(stated, first)
        return turns, f"the images' EXIF orientations differ: all are {first}, as the first one says; {about}"
    if len(asking) == len(stated) and len(set(asking.values())) == 1:
        return asking, f"the images are {first}, as their EXIF orientation says; {about}"
    return asking, f"{len(asking)} of {len(stated)} images are turned as their EXIF orientation says; {about}"

"""Where images come from: one file per source, decoded frame by frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

from modp_ti.sources.distortion import NO_DISTORTION, Distortion
from modp_ti.sources.frame_reader import FrameReader, Picture
from modp_ti.sources.image_folder import ImageFolder
from modp_ti.sources.intrinsics import Intrinsics
from modp_ti.sources.protocol import ImageSource
from modp_ti.sources.undistortion import Undistorter

if TYPE_CHECKING:
    from modp_ti.config import SourceSettings

__all__ = [
    "NO_DISTORTION",
    "Distortion",
    "FrameReader",
    "ImageFolder",
    "ImageSource",
    "Intrinsics",
    "Picture",
    "Undistorter",
    "open_source",
]


def open_source(source: SourceSettings) -> ImageSource:
    """The images that the configuration names. Raises InputError where there are none."""
    assert source.path is not None, "the configuration asks for it"
    return ImageFolder(source.path, source.fps)
